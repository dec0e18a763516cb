"""Algorithm 1: pre-train on reward-free data, then retrieve, clone, collect and update.

Example::

    model = WPT.pretrain("data/dmc", steps=200_000)
    model.set_env("wpt/dmc-walker-run-v0")
    model.learn(75_000)
    action, state = model.predict(obs, state, episode_start, deterministic=True)
"""

import inspect
import os
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor
from torch.optim import AdamW
from torch.optim.lr_scheduler import LinearLR
from tqdm.auto import tqdm

from wpt_agents.agents.official import export_model, import_model
from wpt_agents.data.convert import Data
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.retrieval import Retriever
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.fast.compiled import compile_loops
from wpt_agents.model.behavior_cloning import FRAMES, bc_loss, draw_pairs, random_shift
from wpt_agents.model.networks import Size, find_size, plain_size
from wpt_agents.model.policy import (
    IMAGE_SPACE,
    PriorPolicy,
    WPTPolicy,
    prior_action,
    to_images,
)
from wpt_agents.training.checks import (
    check_dataset,
    check_device,
    check_hyperparameters,
    check_rewards,
    check_trajectory,
    plain,
)
from wpt_agents.training.environments import as_vec_env
from wpt_agents.training.guidance import draw_window, ever, parse_schedule
from wpt_agents.training.pretraining import Pretraining
from wpt_agents.training.rollout import Rollout, last_images, step_all
from wpt_agents.training.spaces import check_spaces
from wpt_agents.training.updates import ACT, CLONE, RETRIEVE, WARMUP, WINDOW, torch_seed

NO_DATASET = (
    "No dataset: nothing is rehearsed, no prior actor guides or is imitated, and model.prior stays "
    "None. Give dataset= to WPT or load, or say offline_ratio=0, guidance=0, kickstart=0 if you "
    "mean it"
)


class WPT(Pretraining, BaseAlgorithm):
    """Generalist world-model pre-training and fine-tuning, in Stable-Baselines3's words.

    Example::

        model = WPT.pretrain("data/dmc", size="small", steps=20_000)
        model.set_env("wpt/dmc-walker-run-v0")
        model.learn(75_000).save("walker.zip")

    `WPT("WPTPolicy", env, offline_ratio=0, guidance=0)` learns from scratch. The defaults are
    Table 2 of the paper; steps are calls of `env.step` (2 frames each at action repeat 2).

    :param policy: "WPTPolicy"
    :param env: an id, a Gymnasium environment or a VecEnv with image observations and Box actions
    :param size: the widths of all networks: debug, tiny, mid, small, medium, paper, or a `Size` or
        its fields
    :param dataset: D_off, for rehearsal and guidance: whatever `TrajectoryDataset.of` takes
    :param max_action_dim: A, the width that all actions are padded to
    :param embodiment: the robot's name; retrieval keeps to data that bears it or no name, and warns
        if there is none
    :param batch_size: sequences in a batch
    :param batch_length: images in a sequence
    :param learning_rate: of world model and reward head; the size's own if None
    :param actor_critic_learning_rate: of actor and critic; the size's own if None
    :param weight_decay: share by which every weight shrinks in a step
    :param grad_clip: largest gradient norm, for each network
    :param gamma: the discount
    :param lam: λ of Eq. (2)
    :param ent_coef: η of Eq. (4)
    :param imagine_horizon: H, imagined steps
    :param imagine_starts: replayed states of a batch from which actor and critic imagine, drawn at
        random; 0 for all of them, as in the paper; the size's own if None
    :param target_fraction: how far the target critic moves at an update
    :param dyn_scale: weight of the KL that teaches the prior
    :param rep_scale: weight of the KL that teaches the posterior
    :param free_nats: KL below which it teaches nothing
    :param free_nats_mode: "mean" (WPT) or "element" (DreamerV3)
    :param data_dependent_init: before the first update of a new world model, standardise what its
        posterior sees by 512 images of the data
    :param unimix: share of the uniform in the latents' distributions
    :param zero_init_heads: start reward head and critic at zero; the size's own if None
    :param return_norm: divide returns by their 5-95 % range, if above 1; the size's own if None
    :param actor_outscale: factor on the initial weights of the actor's last layer
    :param train_ratio: replayed steps per collected step; one update replays B x T
    :param train_freq: when the updates that a step has earned are made: "episode", at its end, as
        in Algorithm 1, or "step", while the environments take the next one: side by side where they
        have processes of their own (`SubprocVecEnv`), and learning the same where they have not
    :param learning_starts: steps collected before the first update; they earn updates, too
    :param warmup_steps: steps driven by the prior actor alone (uniform random without one)
    :param offline_ratio: share of retrieved sequences in a batch; 0: no rehearsal
    :param guidance: schedule of the probability that an episode is guided; 0: none
    :param kickstart: weight, or schedule of it, at which the actor imitates the prior actor on the
        replayed images; not in the paper. 0: off; where the clone is good, try 20
    :param actor_delay: updates of a head start, made when `learning_starts` is reached even if
        fewer have been earned: reward head and critic learn while the actor only imitates the
        prior actor; not in the paper
    :param episode_length: steps of an episode, for the guidance window; found out if None
    :param num_retrieve: R, trajectories to retrieve
    :param retrieval: "nearest", by Eq. (5), or "random", its ablation
    :param bc_steps: updates of the prior actor
    :param bc_batch_size: pairs in each
    :param bc_learning_rate: of the prior actor, at its first update; it falls linearly to 0
    :param precision: "fp32", or "bf16" for the forward passes; on a CPU it pays from `small` on
    :param compile: whether `torch.compile` is to fuse the steps of scan and dream: for a GPU. The
        first updates take minutes, and numbers differ in rounding
    :param tensorboard_log: folder of the TensorBoard events
    :param verbose: 0 nothing, 1 information
    :param seed: of everything that is drawn
    :param device: "auto", "cpu", "cuda", ...
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"WPTPolicy": WPTPolicy}
    policy: WPTPolicy
    policy_class: type[WPTPolicy]
    action_space: spaces.Box
    _last_obs: Any  # SB3's own type does not take all that a VecEnv returns
    _last_episode_starts: np.ndarray
    # Keywords that `__init__` sets, beside those that `Updates` names.
    learning_rate: float
    embodiment: str | None
    unimix: float
    zero_init_heads: bool | None
    actor_outscale: float
    train_ratio: float
    train_freq: str
    learning_starts: int
    warmup_steps: int
    episode_length: int | None
    num_retrieve: int
    retrieval: str
    bc_steps: int
    bc_batch_size: int
    bc_learning_rate: float
    compile: bool

    def __init__(
        self,
        policy: str | type[WPTPolicy] = "WPTPolicy",
        env: GymEnv | str | None = None,
        *,
        size: str | Size | Mapping[str, Any] = "paper",
        dataset: Data | None = None,
        max_action_dim: int = 12,
        embodiment: str | None = None,
        batch_size: int = 16,
        batch_length: int = 64,
        learning_rate: float | None = None,
        actor_critic_learning_rate: float | None = None,
        weight_decay: float = 1e-6,
        grad_clip: float = 100.0,
        gamma: float = 0.99,
        lam: float = 0.95,
        ent_coef: float = 1e-4,
        imagine_horizon: int = 16,
        imagine_starts: int | None = None,
        target_fraction: float = 0.02,
        dyn_scale: float = 1.0,
        rep_scale: float = 0.1,
        free_nats: float = 1.0,
        free_nats_mode: str = "mean",
        data_dependent_init: bool = True,
        unimix: float = 0.01,
        zero_init_heads: bool | None = None,
        return_norm: bool | None = None,
        actor_outscale: float = 1.0,
        train_ratio: float = 256,
        train_freq: str = "episode",
        learning_starts: int = 5_000,
        warmup_steps: int = 7_500,
        offline_ratio: float = 0.25,
        guidance: str | float = "linear(1,0,50000)",
        kickstart: str | float = 0.0,
        actor_delay: int = 0,
        episode_length: int | None = None,
        num_retrieve: int = 500,
        retrieval: str = "nearest",
        bc_steps: int = 150_000,
        bc_batch_size: int = 256,
        bc_learning_rate: float = 1e-4,
        precision: str = "fp32",
        compile: bool = False,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        given = {k: plain(v) for k, v in locals().items() if k in HYPERPARAMETERS}
        check_hyperparameters(given)
        check_device(device)
        widths = find_size(size)
        self.hyperparameters = given = {**given, "size": plain_size(size)}
        for name, value in given.items():
            setattr(self, name, value)
        super().__init__(
            policy,
            None,
            learning_rate=widths.learning_rate if learning_rate is None else learning_rate,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=given["seed"],
            support_multi_env=True,
        )
        self.stream_seed = torch_seed(np.random.default_rng())  # unless a seed is given
        self.observation_space, self.n_envs = IMAGE_SPACE, 1
        self.action_space = spaces.Box(-1.0, 1.0, (max_action_dim,), np.float32)
        self.schedule = parse_schedule(guidance)
        self.kickstart_schedule = parse_schedule(kickstart, np.inf, "kickstart")
        if ever(self.kickstart_schedule) and batch_length < FRAMES:
            raise ValueError(
                f"kickstart looks at {FRAMES} images in a row, but batch_length={batch_length}: "
                f"give batch_length={FRAMES} or more, or kickstart=0"
            )
        self.dataset: TrajectoryDataset | None = None
        self.replay_buffer = ReplayBuffer()
        self.retrieved: ReplayBuffer | None = None
        self.retrieved_ids: list[int] = []
        self.retrieved_of = ""  # the fingerprint of the dataset that they number
        self.pretrain_steps, self.episodes, self.updates = 0, 0, 0
        self.task_updates = 0
        self.initialised = not data_dependent_init  # whether the posterior has been standardised
        self.cloned, self.credit = False, 0.0
        self._rollout: Rollout | None = None
        self._seen_length: int | None = None  # of the longest episode
        self._windows_drawn = 0
        if _init_setup_model:
            self._setup_model()
        self.set_dataset(dataset)
        if env is not None:
            self.set_env(env)

    def _setup_model(self) -> None:
        self.set_random_seed(self.seed)
        size = find_size(self.size)
        small = size.stabilised
        self.return_norm = small if self.return_norm is None else self.return_norm
        zero = small if self.zero_init_heads is None else self.zero_init_heads
        self.policy = self.policy_class(
            self.observation_space,
            self.action_space,
            size,
            self.max_action_dim,
            self.unimix,
            zero,
            self.actor_outscale,
        ).to(self.device)
        if self.compile:
            compile_loops(self.policy)
        self._setup_optimizers()

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds all that is drawn from now on, and the environment's next reset."""
        if seed is not None:
            self.seed = self.stream_seed = seed
            self.hyperparameters = {**self.hyperparameters, "seed": seed}
        super().set_random_seed(seed)

    # ----------------------------------------------------------------- the authors' own weights

    @classmethod
    def from_official(
        cls,
        path: str | os.PathLike[str],
        env: GymEnv | str | None = None,
        dataset: Data | None = None,
        stoch: int | None = None,
        **kwargs: Any,
    ) -> Self:
        """Reads a model file of the paper's authors, such as `dmcontrol.pt`.

        The widths and `max_action_dim` are inferred from the shapes. Reward head, actor, critic and
        target critic are read if the file has them, and drawn if it has not.

        :param path: a `torch.save` file of nested state dicts; it is read with `weights_only=True`
        :param env: the environment to go on with
        :param dataset: D_off, such as the authors' folder `ncrl_datasets/dmcontrol`
        :param stoch: groups of z, if they are not the authors' 32
        :param kwargs: further keywords of `WPT`
        :raises FileNotFoundError: no such file
        :raises ValueError: a file that is cut short, damaged, holds more than weights or is not of
            the authors
        """
        cls._check_keywords(kwargs)
        lean = cls is WPT  # explorers have networks of their own
        model: Self = import_model(cls, path, stoch, lean, **kwargs)
        model.set_dataset(dataset)
        if env is not None:
            model.set_env(env)
        return model

    def save_official(self, path: str | os.PathLike[str]) -> None:
        """Writes the weights in the authors' format, so that their scripts can read them.

        Actor, critic, target critic and reward head are written, too, learnt or not.

        :raises ValueError: a model whose `Size` has other `gates` or `norm_eps` than the authors'
        """
        export_model(self.policy, path)

    # ------------------------------------------------------------------ the data and the task

    def set_dataset(self, dataset: Data | None) -> None:
        """Takes D_off: whatever `TrajectoryDataset.of` takes, other people's files too."""
        if dataset is None:
            return
        dataset = TrajectoryDataset.of(dataset)
        check_dataset(dataset, self.max_action_dim, self.batch_length)
        if self.retrieved_of != dataset.fingerprint:
            self.retrieved = None
        self.dataset = dataset

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return as_vec_env(env, monitor=monitor_wrapper)

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """Takes another environment, with any number of copies and any allowed action width.

        What the replay buffer holds of a robot with another action width is dropped, and so are
        reward head, actor, critic and prior actor; the world model stays.

        :raises ValueError: observations that are no images, actions that are no bounded Box or
            are wider than `max_action_dim`
        """
        wrapped = self._wrap_env(env, self.verbose)
        check_spaces(wrapped, self.max_action_dim)
        assert isinstance(wrapped.action_space, spaces.Box)
        begun = self.episodes or self.retrieved_ids
        if begun and wrapped.action_space.shape != self.action_space.shape:
            self.reset_task()
        self.env, self.n_envs = wrapped, wrapped.num_envs
        self._vec_normalize_env = unwrap_vec_normalize(wrapped)
        self.observation_space, self.action_space = wrapped.observation_space, wrapped.action_space
        self.policy.observation_space = wrapped.observation_space
        self.policy.set_action_space(wrapped.action_space)
        if force_reset:
            self._last_obs = None
        self._rollout = None
        if self.seed is not None:
            wrapped.seed(self.seed)

    def reset_task(self) -> None:
        """Forgets the task and keeps the world model: replay, rewards, behaviour, retrieval go.

        Optimisers, the world model's too, start anew.
        """
        self.replay_buffer, self.retrieved, self.retrieved_ids = ReplayBuffer(), None, []
        self.cloned, self.credit, self._seen_length = False, 0.0, None
        self.task_updates = 0
        self._rollout = self._last_obs = None
        self.policy.reset_behavior()
        self._setup_optimizers()

    # ----------------------------------------------------------------- // Task-Specific Training

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "WPT",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "WPT":
        """Algorithm 1 from its second heading on: retrieve, clone, then collect and update.

        :param total_timesteps: calls of `env.step`, a lower bound
        :param callback: SB3's callbacks
        :param log_interval: episodes between two dumps of the log
        :return: itself
        """
        if self.env is None:
            raise ValueError("No environment: call set_env(env), or pass env= to pretrain or load")
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        try:
            self._retrieve(progress_bar)
            self._clone(progress_bar)
            while self.num_timesteps < total_timesteps:
                if not self._collect(callback, log_interval):
                    break
                self._update_models()
        except BaseException:
            self._last_obs = None  # open episodes may lack a step: the next call begins new ones
            raise
        finally:
            callback.on_training_end()
        return self

    def _retrieve(self, progress_bar: bool) -> None:
        """// Experience Retrieval: the R trajectories that begin most like the task, Eq. (5)."""
        if self.dataset is None and self.retrieved_ids and self.offline_ratio:
            warnings.warn("Rehearsal ends: give dataset= to load, or offline_ratio=0", stacklevel=3)
        wanted = self._needs_clone() or self.offline_ratio
        if self.dataset is None and wanted and not self.retrieved_ids:
            warnings.warn(NO_DATASET, stacklevel=3)
        if self.dataset is None or self.retrieved is not None or not wanted:
            return
        if not self.retrieved_ids or self.retrieved_of != self.dataset.fingerprint:
            query = self.policy.embed(self._first_image())[0]
            self.retrieved_ids = self._search(query, progress_bar)
            self.retrieved_of = self.dataset.fingerprint
        self.retrieved = ReplayBuffer()
        for trajectory in self.dataset.subset(self.retrieved_ids):
            self.retrieved.add(replace(trajectory, reward=None))

    def _first_image(self) -> np.ndarray:
        """(1, 64, 64, 3), the first image of the first environment's open episode."""
        frame = to_images(self._last_obs)[0][0]
        if self._rollout is not None and not self._last_episode_starts.all():
            frame = [*self._rollout.images[0], frame][0]
        return frame[None]

    def _search(self, query: np.ndarray, progress_bar: bool) -> list[int]:
        assert self.dataset is not None
        width, retriever = self.action_space.shape[0], self.build_index(progress_bar)
        names = set(self.dataset.embodiments)
        known = self.embodiment if self.embodiment in names else None
        if self.embodiment is not None and known is None and names != {None}:
            there = ", ".join(sorted(name for name in names if name))
            warnings.warn(
                f"Nothing in the dataset bears the name {self.embodiment!r} ({there}): what is "
                f"retrieved, rehearsed and cloned is of any robot of {width} actions",
                stacklevel=4,
            )
        if self.retrieval == "random":
            found = retriever.draw(self.num_retrieve, self._stream(RETRIEVE, 0), known, width)
        else:
            found, _ = retriever.search(query, self.num_retrieve, known, width)
        if len(found) == 0:
            raise ValueError(
                f"The dataset {self.dataset.path} has no trajectory of {width} actions to "
                "retrieve; add some, or learn with offline_ratio=0, guidance=0, kickstart=0"
            )
        return [int(i) for i in found]

    def build_index(self, progress_bar: bool = False) -> Retriever:
        """The index over the dataset's first images by this encoder, kept beside the dataset."""
        if self.dataset is None:
            raise ValueError("No dataset to index: give dataset= to load or WPT")
        policy = self.policy
        return Retriever.beside(self.dataset, policy.embed, policy.encoder_id(), progress_bar)

    def _clone(self, progress_bar: bool) -> None:
        """// Behavior Cloning Policy Training, on the retrieved trajectories."""
        if self.retrieved is None or self.cloned or not self._needs_clone():
            return
        policy, width, shown = self.policy, self.max_action_dim, self.retrieved.trajectories
        clone = deepcopy(policy.prior_actor)  # so that an interruption leaves nothing half-learnt
        optimizer = AdamW(clone.parameters(), self.bc_learning_rate, weight_decay=0)
        decay = LinearLR(optimizer, 1.0, 0.0, self.bc_steps)  # else the last noisy step is kept
        for step in tqdm(range(self.bc_steps), desc="clone", disable=not progress_bar):
            pairs = draw_pairs(shown, self.bc_batch_size, width, self._stream(CLONE, step))
            image, action = (tensor.to(self.device) for tensor in pairs)
            with self._autocast():
                image = random_shift(image, generator=self._generator(CLONE, step))
                loss = bc_loss(clone(image), action, policy.action_mask)
            self._descend(optimizer, loss, "bc")
            decay.step()
        policy.prior_actor.load_state_dict(clone.state_dict())
        self.cloned = True

    # ------------------------------------------------------------------------- // Collect Data

    def _collect(self, callback: Any, log_interval: int) -> bool:
        """Steps all environments until an episode ends; False when a callback says stop."""
        assert self.env is not None
        rollout = self._open_rollout()
        callback.on_rollout_start()
        go_on, ended = True, False
        while go_on and not ended and self.num_timesteps < self._total_timesteps:
            image, _ = to_images(self._last_obs)
            action = rollout.act(image)
            meanwhile = self._update_models if self.train_freq == "step" else None
            to_env = self.policy.to_env(action)
            new_obs, rewards, dones, infos = step_all(self.env, to_env, meanwhile)
            check_rewards(rewards, self.num_timesteps)
            self.num_timesteps += self.n_envs
            self.credit += self.n_envs
            last = last_images(self.env, infos, dones, new_obs)
            finished = rollout.end_step(rewards, dones, last)
            for trajectory in finished:  # before the callback, which may save the replay buffer
                for name, error in self.policy.heldout_errors(trajectory).items():
                    self.logger.record_mean(f"train/heldout_{name}_error", error)
                self.replay_buffer.add(trajectory)
                self._seen_length = max(self._seen_length or 0, len(trajectory))
            self.episodes += len(finished)
            callback.update_locals(locals())
            go_on = callback.on_step()
            self._update_info_buffer(infos, dones)
            self._log_episodes(log_interval, len(finished))
            self._last_obs, self._last_episode_starts = new_obs, dones
            ended = bool(dones.any())
        if go_on:
            callback.on_rollout_end()
        return go_on

    def _open_rollout(self) -> Rollout:
        if self._rollout is None or self._last_episode_starts.all():
            self._rollout = Rollout(
                self.policy,
                self.n_envs,
                self.action_space.shape[0],
                self._draw_window,
                self._guide,
                self._generator(ACT, self.episodes),
                self.embodiment,
            )
        return self._rollout

    def _draw_window(self) -> tuple[int, int]:
        """Decides at an episode's start whether, and when, the prior actor drives."""
        length = self._episode_length()
        if self.num_timesteps < self.warmup_steps:
            return 0, sys.maxsize  # all of it, however long it lasts
        probability = self.schedule(self.num_timesteps) if self.cloned else 0.0
        self._windows_drawn += 1
        return draw_window(probability, length, self._stream(WINDOW, self._windows_drawn))

    def _episode_length(self) -> int:
        """As given, or the longest so far, or what the environment says, or a guess."""
        if length := self.episode_length or self._seen_length:
            return length
        assert self.env is not None
        spec = self.env.get_attr("spec")[0] if self.env.has_attr("spec") else None
        return getattr(spec, "max_episode_steps", None) or 500

    def _needs_clone(self) -> bool:
        """Whether the prior actor will ever drive, or be imitated."""
        return ever(self.schedule) or ever(self.kickstart_schedule)

    def _guide(self, frames: np.ndarray) -> np.ndarray:
        """Act as the prior actor, or at random in the warm-up where there is none."""
        if self.cloned:
            return prior_action(self.policy, frames)
        mask = self.policy.action_mask.cpu().numpy()
        rng = self._stream(WARMUP, self.num_timesteps)
        return (rng.uniform(-1, 1, (len(frames), len(mask))) * mask).astype(np.float32)

    # ------------------------------------------------------------------------ // Update Models

    def _update_models(self) -> None:
        """The gradient steps that the collected steps have earned."""
        if not self.replay_buffer.trajectories or self.train_ratio == 0:
            return
        if self.num_timesteps < self.learning_starts:
            return  # these steps earn updates, too, which are made once learning starts
        price = self.batch_size * self.batch_length / self.train_ratio
        updates = max(int(self.credit / price), self.actor_delay - self.task_updates)
        rest = max(self.credit - updates * price, 0.0)
        metrics: dict[str, list[Tensor]] = defaultdict(list)
        for left in reversed(range(updates)):
            self.update(metrics)
            self.credit = rest + left * price  # so that an interruption costs no updates
        for key, values in metrics.items():
            self.logger.record_mean(key, torch.stack(values).mean().item())

    # ------------------------------------------------------------------------------- acting

    @property
    def prior(self) -> PriorPolicy | None:
        """The prior actor, with `predict`; None before it is cloned."""
        return PriorPolicy(self.policy) if self.cloned else None

    def open_loop(self, trajectory: Trajectory, context: int = 5, horizon: int = 40) -> np.ndarray:
        """What the world model expects to see: (T, 64, 64, 3) uint8, `context` of them filtered.

        :raises ValueError: no context, more actions than the model takes, images of another size
        """
        if context < 1:
            raise ValueError(f"context counts the images that are seen, at least 1, got {context}")
        check_trajectory(trajectory, self.max_action_dim)
        return self.policy.open_loop(trajectory, context, horizon)

    # ------------------------------------------------------------------------------- logging

    def _log_episodes(self, log_interval: int | None, new: int) -> None:
        before = self.episodes - new
        if not log_interval or before // log_interval == self.episodes // log_interval:
            return
        assert self.ep_info_buffer is not None and self.ep_success_buffer is not None
        record = self.logger.record
        if self.ep_info_buffer:
            record("rollout/ep_rew_mean", safe_mean([e["r"] for e in self.ep_info_buffer]))
            record("rollout/ep_len_mean", safe_mean([e["l"] for e in self.ep_info_buffer]))
        if self.ep_success_buffer:
            record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        seconds = max(time.time_ns() - self.start_time, 1) / 1e9
        record("time/episodes", self.episodes, exclude="tensorboard")
        record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / seconds))
        record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        record("train/updates", self.updates)
        self.logger.dump(step=self.num_timesteps)


KEYWORDS = set(inspect.signature(WPT.__init__).parameters) - {"self", "_init_setup_model"}
HYPERPARAMETERS = KEYWORDS - {"policy", "env", "dataset", "tensorboard_log", "verbose", "device"}
