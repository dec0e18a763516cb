"""The keywords of WPT: Table 2 of the paper, and keywords that are not in the paper.

A new keyword is declared here and used in one other place. The signature of `WPT`, its attributes,
its documentation, its checks and the zoo's list of what pre-training depends on follow from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from wpt_agents.model.behavior_cloning import BC_VARIANCES, FRAMES
from wpt_agents.model.distributions import BIN_RANGE
from wpt_agents.model.sizes import Size, find_size, plain_size
from wpt_agents.training.guidance import Schedule, ever, parse_schedule
from wpt_agents.training.keywords import (
    Keywords,
    Stage,
    amount,
    choice,
    count,
    is_number,
    keyword,
    must,
    schedule,
    share,
    switch,
)
from wpt_agents.training.kickstarting import Adaptive, check_kickstart, parse_kickstart

SIZES_OWN = {  # keywords that take the size's value if None, and the field of `Size` to read
    "learning_rate": "learning_rate",
    "actor_critic_learning_rate": "actor_critic_learning_rate",
    "imagine_starts": "imagine_starts",
    "zero_init_heads": "stabilised",
    "return_norm": "stabilised",
    "learning_starts": "learning_starts",
    "warmup_steps": "warmup_steps",
    "guidance": "guidance",
    "num_retrieve": "num_retrieve",
    "bc_steps": "bc_steps",
    "bc_batch_size": "bc_batch_size",
}


def check_size(name: str, value: Any) -> None:
    """Raise an error if the value is not a size."""
    find_size(value)


@dataclass(frozen=True, kw_only=True)
class Hyperparameters(Keywords):
    """The keywords of WPT. Steps are calls of `env.step` (2 frames each at action repeat 2)."""

    sizes_own: ClassVar[Mapping[str, str]] = SIZES_OWN

    # The networks.
    size: str | Size | Mapping[str, Any] = keyword(  # noqa: RUF009  # a field, as the others are
        "paper",
        check_size,
        "widths of all networks: debug, tiny, mid, small, medium, paper, or a `Size` or its fields",
        Stage.SIZE,
    )
    # 12 is the widest robot of the 72 tasks, the quadruped; the authors pad to 21.
    max_action_dim: int = count(12, "A, the width that all actions are padded to", Stage.SIZE)
    unimix: float = share(
        0.01,
        "share of the uniform distribution that is mixed into the distributions of the latents, so "
        "that their KL stays finite",
        Stage.SIZE,
        positive=True,
    )
    zero_init_heads: bool | None = switch(
        None,
        "start reward head and critic at zero; None: the size decides. Heads that are loaded stay "
        "as they are until `reset_task`",
        Stage.DRAWING,
    )
    actor_outscale: float = amount(
        1.0,
        "factor on the initial weights of the actor's last layer. An actor that is loaded stays as "
        "it is until `reset_task`",
        Stage.DRAWING,
    )
    bin_range: float = keyword(
        BIN_RANGE,
        must("a number above 0", lambda value: is_number(value) and value > 0),
        "the 255 bins of reward head and critic reach from minus to plus this number, in symlog "
        "space: 20 is a return of 485 million, 7 is one of 1,096. Larger returns are clipped",
        Stage.SIZE,
    )
    data_dependent_init: bool = switch(
        True,
        "before the first update of a new world model, standardise the inputs of its posterior "
        "with the statistics of 512 images of the data; not in the paper",
        Stage.SIZE,
    )
    compile: bool = switch(
        False,
        "compile the recurrent steps with `torch.compile`, for a GPU. The first updates take "
        "minutes, and numbers differ in rounding",
        Stage.SIZE,
    )

    fast: bool = switch(
        True,
        "use the faster implementations in `wpt_agents.fast`; False, for debugging, uses the plain "
        "definitions in `wpt_agents.model`",
        Stage.ACTING,
    )

    # The world model, in pre-training and in fine-tuning.
    batch_size: int = count(16, "B, sequences in a batch", Stage.PRETRAINING)
    batch_length: int = count(64, "T, images in a sequence", Stage.PRETRAINING)
    learning_rate: float | None = amount(
        None,
        "learning rate of world model and reward head; None: the size's value",
        Stage.PRETRAINING,
    )
    weight_decay: float = amount(
        1e-6, "share by which every weight shrinks in an update", Stage.PRETRAINING
    )
    grad_clip: float = amount(
        100.0, "largest norm of the gradient of each network", Stage.PRETRAINING
    )
    dyn_scale: float = amount(1.0, "weight of the KL that trains the prior", Stage.PRETRAINING)
    rep_scale: float = amount(0.1, "weight of the KL that trains the posterior", Stage.PRETRAINING)
    free_nats: float = amount(
        1.0, "value in nats below which the KL is not minimised further", Stage.PRETRAINING
    )
    free_nats_mode: str = choice(
        "mean",
        ("mean", "element"),
        'what `free_nats` applies to: the "mean" KL of a batch (WPT) or each "element" of it '
        "(DreamerV3)",
        Stage.PRETRAINING,
    )
    pixel_weight: float = amount(
        1.0,
        "weight in Eq. (1) of the pixels that differ from their trajectory's median image, so that "
        "small moving things are not lost in a large background; not in the paper. 1: off",
        Stage.PRETRAINING,
    )
    precision: str = choice(
        "fp32",
        ("fp32", "bf16"),
        'precision of the forward passes: "fp32", or "bf16", which on a CPU is faster from size '
        "`small` on",
        Stage.PRETRAINING,
    )

    # Actor and critic.
    actor_critic_learning_rate: float | None = amount(
        None, "learning rate of actor and critic; None: the size's value"
    )
    actor_critic_decay: bool = switch(
        False,
        "let the learning rate of actor and critic fall linearly to 0 during a call of `learn`, so "
        "that the last policy does not depend on a few noisy updates; not in the paper",
    )
    actor_average: float = share(
        0.0,
        "share by which a moving average of the actor follows it in an update. The average acts in "
        "the environment, the actor itself in imagination. Not in the paper; 0: off",
    )
    gamma: float = share(0.99, "discount factor")
    lam: float = share(0.95, "λ of the λ-return, Eq. (2)")
    ent_coef: str | float = schedule(
        1e-4,
        np.inf,
        "η of Eq. (4), the weight of the entropy: a number, or a schedule such as "
        "'linear(3e-3,3e-4,20000)', which falls from 3e-3 to 3e-4 over 20,000 steps",
    )
    imagine_horizon: int = count(  # the value of the first state is no action's
        16, "H, imagined steps", least=2
    )
    imagine_starts: int | None = count(
        None,
        "number of replayed states of a batch, drawn at random, from which actor and critic "
        "imagine; 0 for all of them, as in the paper; None: the size's value",
        least=0,
    )
    target_fraction: float = share(
        0.02, "share by which the target critic moves to the critic in an update"
    )
    return_norm: bool | None = switch(
        None, "divide returns by their 5-95 % range, if it is above 1; None: the size decides"
    )
    train_ratio: float = amount(
        256, "replayed steps for each collected step; an update replays B x T steps"
    )
    offline_ratio: float = share(
        0.25, "share of retrieved sequences in a batch (experience rehearsal); 0: no rehearsal"
    )
    kickstart: str | float = keyword(
        0.0,
        check_kickstart,
        "weight, or a schedule of it, of a loss with which the actor imitates the prior actor on "
        "replayed images; not in the paper. 0: off; if the prior actor is good, try 20. "
        "'adaptive(20,1)' falls from 20 to 1 while the newest episodes return as much as "
        "those of the warm-up, in which the prior actor acts, and rises again while they do not",
    )
    actor_delay: int = count(
        0,
        "number of updates of a head start, in which reward head and critic learn while the actor "
        "only imitates the prior actor. They are made when `learning_starts` is reached, even if "
        "`train_ratio` allows fewer. Not in the paper",
        least=0,
    )
    imitation_steps: int = count(
        0,
        "number of updates with which the actor imitates the prior actor after the head start, "
        "while the world model does not change. They take milliseconds each. Not in the paper",
        least=0,
    )

    actor_grad: str = choice(
        "dynamics",
        ("dynamics", "reinforce"),
        'gradient of the actor: through the dynamics, as in the paper, or "reinforce" (DreamerV3), '
        "which needs no gradient through the imagined steps",
    )
    repval_scale: float = amount(
        0.0,
        "weight of DreamerV3's replay value loss, which trains the critic on returns of replayed "
        "steps; not in the paper. DreamerV3 has 0.3",
    )
    slow_critic_scale: float = amount(
        0.0,
        "weight of DreamerV3's regulariser that pulls the critic to the target critic's values on "
        "imagined steps; not in the paper. DreamerV3 has 1",
    )
    recent_share: float = share(
        0.0,
        "share of a batch's online sequences that are drawn from the five newest episodes; not in "
        "the paper",
    )

    reward_grad: float = amount(
        0.0,
        "weight of the reward loss in the training of the world model. At 0, as in the paper, "
        "latent states represent only what the reconstruction of images needs; DreamerV3 has 1",
    )
    imitation_grad: float = amount(
        0.0,
        "weight of the imitation loss (`kickstart`, `actor_delay`) in the training of the world "
        "model, so that latent states represent what the prior actor's actions depend on. The loss "
        "is small: weights of some hundreds have an effect. Not in the paper",
    )
    reward_ensemble: int = count(
        1,
        "number of reward heads; imagined rewards are their mean, minus what `pessimism` subtracts",
    )
    pessimism: str | float = schedule(
        0.0,
        np.inf,
        "β, or a schedule of it: imagined rewards are the mean of the reward heads minus β times "
        "their standard deviation, so that the actor does not seek states of unknown reward. Let "
        "it fade, or exploration stops. Not in the paper",
    )
    continue_head: bool = switch(
        True,
        "once an episode of the task has terminated, learn where episodes end, and let imagined "
        "returns end there, as in DreamerV3. No task of the paper terminates",
    )

    # Collecting.
    learning_starts: int | None = count(
        None,
        "steps that are collected before the first update; the updates for these steps are made "
        "then, too. None: the size's value, 5,000 for `paper`",
        Stage.ACTING,
        least=0,
    )
    warmup_steps: int | None = count(
        None,
        "number of steps at the beginning, in which the prior actor acts alone (without one, "
        "actions are uniformly random). None: the size's value, 7,500 for `paper`",
        Stage.ACTING,
        least=0,
    )
    guidance: str | float | None = schedule(
        None,
        1.0,
        "probability that an episode is guided by the prior actor: a number, or a schedule "
        "'linear(start,end,steps)'; 0: no guidance. None: the size's value, 'linear(1,0,50000)' "
        "for `paper`",
        Stage.ACTING,
    )
    ibrl: bool = switch(
        False,
        "at each step that is not guided, also in `predict`, let the critic choose between the "
        "actions of actor and prior actor, by the values of the states that they lead to (IBRL); "
        "not in the paper",
        Stage.ACTING,
    )
    residual: bool = switch(
        False,
        "act by the prior actor's action plus the difference between the actor and a copy of it "
        "that goes on imitating the prior actor, so that learning begins at the prior actor itself "
        "and not at an imitation of it from latent states; not in the paper. Use it with "
        "`kickstart`: where the actor does not imitate, the sum comes to be its own action",
        Stage.ACTING,
    )
    episode_length: int | None = count(
        None,
        "number of steps of an episode, for the guidance window; None: that of the longest episode "
        "so far",
        Stage.ACTING,
    )
    embodiment: str | None = keyword(
        None,
        Keywords.declared()["embodiment"].check,
        "name of the robot; retrieval uses only trajectories of this name or without a name, and "
        "warns if no trajectory has this name",
        Stage.ACTING,
    )

    # Retrieval and the prior actor.
    num_retrieve: int | None = count(
        None,
        "R, number of trajectories to retrieve. None: the size's value, 500 for `paper`",
        Stage.RETRIEVAL,
    )
    retrieval: str = choice(
        "nearest",
        ("nearest", "random"),
        '"nearest", by Eq. (5), or "random", its ablation',
        Stage.RETRIEVAL,
    )
    retrieval_images: int = count(
        1,
        "number of first images of the task that Eq. (5) compares; each contributes its nearest "
        "trajectories in turn. Above 1, the environment is reset that many times before anything "
        "is collected, and retrieval confuses fewer tasks that look alike",
        Stage.RETRIEVAL,
    )
    bc_steps: int | None = count(
        None,
        "number of updates of the prior actor. None: the size's value, 150,000 for `paper`",
        Stage.CLONING,
    )
    bc_batch_size: int | None = count(
        None,
        "batch size of the prior actor. None: the size's value, 256 for `paper`",
        Stage.CLONING,
    )
    bc_learning_rate: float = amount(
        1e-4,
        "learning rate of the prior actor at its first update, from which it falls linearly to 0",
        Stage.CLONING,
    )
    bc_shift: int = count(
        3,
        "largest random shift, in pixels, of the images that the prior actor is trained on. The "
        "paper does not state it; 3 is the value in the authors' code",
        Stage.CLONING,
        least=0,
    )
    bc_variance: str = choice(
        "fixed",
        BC_VARIANCES,
        'variance of the prior actor\'s Gaussian: "fixed", the same for all trajectories, or '
        '"trajectory", estimated for each of them from its errors, so that noisy trajectories '
        "count less. Not in the paper",
        Stage.CLONING,
    )
    adapt_steps: int = count(
        0,
        "number of updates of the world model on the retrieved trajectories alone, before anything "
        "is collected, so that it represents what they show of the task. Not in the paper",
        least=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "size", plain_size(self.size))
        if self.pessimistic and self.reward_ensemble == 1:
            raise ValueError(
                f"pessimism={self.pessimism!r} needs several reward heads, "
                "but reward_ensemble=1: use reward_ensemble=3 or more, or pessimism=0"
            )
        imitating = {
            "kickstart": self.imitates,
            "residual": self.residual,
            "actor_delay": self.actor_delay and self.needs_clone,
            "imitation_steps": self.imitation_steps and self.needs_clone,
        }
        name = next((name for name, on in imitating.items() if on), None)
        if name is not None and self.batch_length < FRAMES:
            raise ValueError(
                f"{name} imitates the prior actor, which needs {FRAMES} images in a row, but "
                f"batch_length={self.batch_length}: use batch_length={FRAMES} or more, or leave "
                f"{name} out"
            )

    @property
    def marks(self) -> bool:
        """Whether batches must mark the pixels that move."""
        return self.pixel_weight != 1

    @property
    def pessimistic(self) -> bool:
        """Whether imagined rewards are ever lower than the mean of the reward heads."""
        return ever(self._schedule("pessimism"))

    @property
    def imitates(self) -> bool:
        """Whether the actor ever imitates the prior actor in its loss."""
        return ever(self.kickstart_at)

    @property
    def adapts(self) -> bool:
        """Whether the weight of the imitation loss depends on the returns."""
        return isinstance(parse_kickstart(self.kickstart), Adaptive)

    @property
    def retrieves(self) -> bool:
        """Whether trajectories are retrieved, to be cloned, rehearsed or adapted to."""
        return bool(self.needs_clone or self.offline_ratio or self.adapt_steps)

    @property
    def needs_clone(self) -> bool:
        """Whether the prior actor will ever act or be imitated."""
        return self.imitates or self.ibrl or self.residual or ever(self._schedule("guidance"))

    def pessimism_at(self, step: int) -> float:
        """Return the factor β on the standard deviation of the reward heads at this step."""
        return self._schedule("pessimism")(step)

    def guidance_at(self, step: int) -> float:
        """Return the probability that an episode that begins at this step is guided."""
        return self._schedule("guidance")(step)

    def ent_coef_at(self, step: int) -> float:
        """Return the weight of the entropy at this step."""
        return self._schedule("ent_coef")(step)

    def kickstart_at(
        self, step: int, prior: Sequence[float] = (), later: Sequence[float] = ()
    ) -> float:
        """Return the weight of the imitation loss at this step.

        :param step: collected steps

        :param prior: returns of the episodes in which the prior actor acted alone
        :param later: returns of the episodes after these
        """
        weight = parse_kickstart(self.kickstart)
        return weight.weight(prior, later) if isinstance(weight, Adaptive) else weight(step)

    def _schedule(self, name: str) -> Schedule:
        """Return a keyword as a function of the step; its range was checked before."""
        return parse_schedule(self.value(name), np.inf, name)


FINE_TUNING = Hyperparameters.of_stages(
    *(set(Stage) - {Stage.SIZE, Stage.DRAWING, Stage.PRETRAINING})
)
