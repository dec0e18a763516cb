"""R3M (Nair et al., 2022): a frozen encoder that was pre-trained by time-contrastive learning.

Source: https://arxiv.org/abs/2203.12601. The language loss of R3M is left out, since our data
contain no language. DrQ-v2's actor and critic learn on the frozen features, as in
https://arxiv.org/abs/2212.05749.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor, nn
from torch.optim import Adam

from wpt_agents.agents.drqv2 import DrQv2, DrQv2Keywords, DrQv2Learner, DrQv2Policy
from wpt_agents.agents.frame_agent import FrameProgress
from wpt_agents.data.bars import shown
from wpt_agents.data.convert import Data
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.model_file import read_model
from wpt_agents.model.behavior_cloning import FRAMES
from wpt_agents.model.frames import FrameEncoder
from wpt_agents.model.resnet import ResNet, read_r3m
from wpt_agents.model.time_contrastive import (
    aligned,
    derangements,
    draw_clips,
    r3m_loss,
    random_crop,
)
from wpt_agents.training.descent import descend
from wpt_agents.training.keywords import Stage, choice, count, keyword, must
from wpt_agents.training.pretraining import Callback, Pretraining
from wpt_agents.training.randomness import Purpose

BACKBONES = ("conv", "resnet18", "resnet34", "resnet50")
NEGATIVES = 3  # other clips that each clip is contrasted with
IN_MEMORY = 4e9  # bytes of images; larger datasets are read from the disk in every update


def images_of(dataset: TrajectoryDataset) -> Callable[[int, list[int]], np.ndarray]:
    """Return a function: number of a trajectory, n times -> its images there, (n, 64, 64, 3)."""
    if (dataset.lengths + 1).sum() * 3 * dataset.image_size**2 > IN_MEMORY:
        return dataset.images
    loaded = [trajectory.image for trajectory in dataset]

    def images(i: int, times: list[int]) -> np.ndarray:
        chosen: np.ndarray = loaded[i][times]
        return chosen

    return images


class FrameFeatures(nn.Module):
    """Features of single images, and of stacks of them: the encoder that is frozen downstream.

    :param backbone: "conv", DrQ-v2's convolutions and a linear layer of 512, or a ResNet
    :param channels: the number of channels of the convolutions
    """

    def __init__(self, backbone: str, channels: int) -> None:
        super().__init__()
        if backbone == "conv":
            body = FrameEncoder((channels,) * 4, (2, 1, 1, 1), frames=1, centre=0.5)
            # 512, as wide as a ResNet18's output
            self.body: nn.Module = nn.Sequential(body, nn.Linear(body.embed_dim, 512))
            self.width = 512
        else:
            self.body = ResNet(int(backbone.removeprefix("resnet")))
            self.width = self.body.features
        self.backbone = backbone
        self.embed_dim = FRAMES * self.width

    def features(self, image: Tensor) -> Tensor:
        """(N, 64, 64, 3) -> (N, Z)."""
        features: Tensor = self.body(image[:, None] if self.backbone == "conv" else image)
        return features

    def forward(self, frames: Tensor) -> Tensor:
        """(N, F, 64, 64, 3) uint8, or features (N, F, Z) of these images -> (N, F Z)."""
        if frames.dtype == torch.uint8:
            frames = self.features(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        return frames.flatten(1).float()


class R3MPolicy(DrQv2Policy):
    """DrQ-v2's actor and critic on a frozen encoder, which new tasks keep.

    Its widths are those of DrQ-v2, and `backbone` of `FrameFeatures`.
    """

    def make_encoder(self, channels: int) -> Any:
        """Keep the encoder, or initialise it if there is none yet."""
        if hasattr(self, "encoder"):
            return self.encoder
        return FrameFeatures(self.widths.backbone, channels).requires_grad_(False)


class R3MLearner(DrQv2Learner):
    """The update of DrQ-v2 on frozen features, and the pre-training of the encoder."""

    policy: R3MPolicy

    def __init__(self, policy: R3MPolicy, settings: "R3MKeywords") -> None:
        super().__init__(policy, settings)
        self.encoder_optimizer = Adam(
            policy.encoder.parameters(), settings.learning_rate, fused=True
        )

    def pretrain(self, clips: Tensor, others: Tensor) -> dict[str, Tensor]:
        """Make one update of the encoder by `r3m_loss`.

        :param clips: (B, 3, 64, 64, 3), three images of each clip, cropped
        :param others: (K, B), the numbers of the clips that each clip is contrasted with
        """
        encoder = self.policy.encoder.requires_grad_(True)
        z = encoder.features(clips.flatten(0, 1)).unflatten(0, clips.shape[:2])
        loss = r3m_loss(z, others)
        descend(self.encoder_optimizer, loss, "R3M")
        encoder.requires_grad_(False)
        return {"pretrain/r3m_loss": loss.detach(), "pretrain/aligned": aligned(z.detach())}


@dataclass(frozen=True, kw_only=True)
class R3MKeywords(DrQv2Keywords):
    """The keywords of `R3M`; pre-training's are those of its published code."""

    backbone: str = choice("conv", BACKBONES, "the encoder of single images", Stage.SIZE)
    clips: int = count(16, "clips in a batch of pre-training", Stage.PRETRAINING, least=2)
    weights: str | None = keyword(
        None,
        must("the path of a file", lambda value: isinstance(value, str)),
        "file of R3M's authors, such as r3m_18.pt, that the encoder is read from when the agent is "
        "made; `pretrain` then makes no updates. `backbone` must fit the file. A model file holds "
        "the network itself, so that this has no effect in `load`",
        Stage.SIZE,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frame_differences:
            raise ValueError(
                f"frame_differences={self.frame_differences} needs an encoder of several frames, "
                "and R3M encodes single images: leave it at 0"
            )


@dataclass(kw_only=True)
class R3MProgress(FrameProgress):
    """Counters of an `R3M` agent, including its pre-training."""

    pretrain_steps: int = 0


class R3M(DrQv2, keywords=R3MKeywords, progress=R3MProgress):
    """DrQ-v2 on frozen features that were pre-trained by time-contrastive learning.

    Example::

        model = R3M.pretrain("data/dmc", steps=20_000)
        model.set_env("wpt/dmc-walker-run-v0")
        model.learn(75_000)

    `R3M(..., backbone="resnet18", weights="r3m_18.pt")` has the network that R3M's authors publish.
    There is no augmentation, so each image is encoded once, and its features are stored with the
    episode.

    :param policy: "CnnPolicy"
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": R3MPolicy}
    saved_as = "R3M"
    uses_data = True
    policy: R3MPolicy
    learner: R3MLearner
    hyperparameters: R3MKeywords
    progress: R3MProgress
    shape_keywords = (*DrQv2.shape_keywords, "backbone")
    _features: list[np.ndarray]  # of each episode of `_features_of`
    _features_of: ReplayBuffer | None = None

    def make_learner(self) -> R3MLearner:
        """Make the optimisers."""
        return R3MLearner(self.policy, self.hyperparameters)

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.hyperparameters.weights is not None:
            self.load_weights(self.hyperparameters.weights)

    def description(self) -> dict[str, Any]:
        """Return what a model file says of this agent besides its tensors."""
        described = super().description()
        described["hyperparameters"]["weights"] = None  # the encoder is among the tensors
        return described

    def load_weights(self, path: str | os.PathLike[str]) -> None:
        """Load the encoder's weights from a file that R3M's authors publish, such as `r3m_18.pt`.

        :param path: the file
        :raises ValueError: the file has another layout, or another depth than `backbone`
        """
        body, weights = self.policy.encoder.body, read_r3m(os.fspath(path))
        if not isinstance(body, ResNet) or body.state_dict().keys() != weights.keys():
            raise ValueError(
                f"{os.fspath(path)} does not fit backbone={self.hyperparameters.backbone!r}: make "
                "the agent with the backbone of the file, 'resnet18', 'resnet34' or 'resnet50'"
            )
        body.load_state_dict(weights)
        self._features_of = None

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """Load weights and optimisers in place, and drop the features of the previous encoder.

        The parameters are those of `SavedAgent.set_parameters`.
        """
        super().set_parameters(*args, **kwargs)
        self._features_of = None

    def seen(self, replay: ReplayBuffer) -> list[np.ndarray]:
        """Return the features of each episode, float16, which are computed once."""
        if self._features_of is not replay:
            self._features = []
            self._features_of = replay
        for trajectory in replay.trajectories[len(self._features) :]:
            self._features.append(self._encode(trajectory.image))
        return self._features

    @torch.no_grad()
    def _encode(self, image: np.ndarray) -> np.ndarray:
        parts = torch.from_numpy(image).split(64)
        encoded = [self.policy.encoder.features(part.to(self.device)).half() for part in parts]
        return torch.cat(encoded).cpu().numpy()

    @classmethod
    def pretrain(
        cls,
        dataset: Data,
        env: GymEnv | str | None = None,
        steps: int = 20_000,
        run_dir: str | os.PathLike[str] | None = None,
        seed: int | None = None,
        progress_bar: bool = False,
        callback: Callback | None = None,
        accumulate: int = 1,
        **kwargs: Any,
    ) -> Self:
        """Train the encoder on reward-free trajectories of any robots.

        :param dataset: what the keyword `dataset` takes
        :param env: the environment to continue with, if known
        :param steps: number of updates; none are made with `weights`
        :param run_dir: folder of `model.zip`, which is written every 1,000 updates, at the end, and
            on Ctrl-C or SIGTERM, and of the learning curve, `progress.csv` and TensorBoard events.
            If a model is there, training continues from it
        :param seed: seed of all random numbers; None: a random seed
        :param progress_bar: show a progress bar
        :param callback: called after every update with (step, metrics)
        :param accumulate: must be 1; accepted because `WPT.pretrain` has it
        :param kwargs: keywords of `R3M`
        """
        if accumulate != 1:
            raise ValueError(
                f"R3M makes each update in one pass, got accumulate={accumulate}: leave it out"
            )
        cls.check_keywords(kwargs)
        steps = int(steps)  # of 2e4, too
        model = cls(seed=seed, **kwargs)
        checked = None if env is None else model._checked(env)  # not after hours of training
        model.set_dataset(dataset)
        folder = Path(run_dir) if run_dir is not None else None
        if folder is not None and (folder / "model.zip").exists():
            model.restore(*read_model(folder / "model.zip"), (*cls.shape_keywords, "clips"))
        if model.hyperparameters.weights is None:
            with Pretraining(model, steps, folder, callback) as run:
                model._pretrain(steps, run, progress_bar)
        elif folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            model.save(folder / "model.zip")
        if checked is not None:
            model._use_env(checked)
        return model

    def _pretrain(self, steps: int, run: Pretraining, progress_bar: bool) -> None:
        assert self.dataset is not None
        lengths, images = self.dataset.lengths, images_of(self.dataset)
        done = self.progress.pretrain_steps
        for step in shown(range(done, steps), steps, "pre-train", progress_bar, done):
            rng = self.streams.numpy(Purpose.PRETRAIN, step)
            clips = draw_clips(lengths, images, self.hyperparameters.clips, rng)
            others = derangements(len(clips), NEGATIVES, rng).to(self.device)
            clips = random_crop(clips, rng).to(self.device)
            run.finish_update(self.learner.pretrain(clips, others))
