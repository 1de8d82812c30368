"""The settings of Option-Critic (baselines/option_critic.py), each with its source."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from hippo.core.budget import BudgetConfig
from hippo.core.settings import MOST_SKILLS, WIDEST, ConfigError, setting
from hippo.core.view import check_view


@dataclass
class OptionCriticConfig(BudgetConfig):
    """Every setting; the defaults are those that PPOC was published with, as the paper names none but the options.

    `code` names github.com/mklissa/PPOC.
    """

    iterations: int = setting(dataclasses.MISSING, "training iterations", code="488 of 2048 steps", low=1)
    num_skills: int = setting(6, "number of options", paper="6 skills (App. A)", code="2", low=1, high=MOST_SKILLS)
    ppoc_faithful: bool = setting(
        False,
        "the losses and the one Adam of PPOC's code instead of the option-critic's gradients",
        code="yes (pposgd_simple.py:209-226)",
        ours="no: its termination and policy over options follow no gradient of the return",
    )
    deliberation_cost: float = setting(
        0.0, "cost of a termination, in units of the scaled reward", code="0; 0.1 in the README's example", low=0.0
    )
    termination_bias: float = setting(
        0.0, "initial bias of the terminations' logits; -2.197 makes options last 10 steps", code="0: 2 steps"
    )
    manager_entropy_weight: float = setting(
        0.1, "weight of the entropy of the policy over options", code="0.1 (pposgd_simple.py:224)", low=0.0
    )
    reward_scale: float = setting(
        0.1, "factor on the rewards that are learnt from; not used with one option", code="0.1", above=0.0
    )
    observation_filter: bool = setting(
        True,
        "standardise observations by their running mean and deviation; never with given skills, which it would change",
        code="yes (mlp_policy.py)",
    )
    steps_per_update: int = setting(
        2048,
        "environment steps, of all environments together, between updates; 0: the whole iteration",
        code="2048 (run_mujoco.py)",
        low=0,
    )
    updates: int = setting(10, "passes over the data of an update", code="10 (run_mujoco.py)", low=1)
    minibatch_size: int = setting(
        32, "rows per gradient step; 0: all", code="32 with two options, 64 with one (run_mujoco.py)", low=0
    )
    critic_minibatch_size: int = setting(32, "rows per gradient step of the critic; 0: all", code="32", low=0)
    learning_rate: float = setting(3e-4, "Adam step size of the intra-option policies", code="3e-4", above=0.0)
    critic_learning_rate: float = setting(3e-4, "Adam step size of the critic", code="3e-4", above=0.0)
    manager_learning_rate: float = setting(
        3e-4, "Adam step size of the policy over options", code="3e-4, on a loss 32 times as large", above=0.0
    )
    termination_learning_rate: float = setting(
        2e-4,
        "Adam step size of the terminations",
        code="5e-7 through the Adam of all losses, which in effect makes steps of 2e-4 (pposgd_simple.py:411)",
        above=0.0,
    )
    adam_epsilon: float = setting(1e-5, "Adam's epsilon", code="1e-5", above=0.0)
    clip_range: float = setting(0.2, "clipping parameter epsilon", code="0.2 (run_mujoco.py)", above=0.0)
    gamma: float = setting(0.99, "discount per environment step", code="0.99 (run_mujoco.py)", above=0.0, high=1.0)
    gae_lambda: float = setting(0.95, "GAE lambda", code="0.95 (run_mujoco.py)", low=0.0, high=1.0)
    skill_hidden_sizes: list[int] = setting(
        [64, 64],
        "hidden layers of the intra-option policies",
        paper="2 x 64 (App. A)",
        code="2 x 64",
        low=1,
        high=WIDEST,
    )
    skill_integration: str = setting(
        "bilinear",
        "how the option enters their network",
        code="one linear head per option",
        ours="HiPPO's, so that given skills can be loaded",
        choices=("bilinear", "concatenate"),
    )
    skill_observation: str = setting(
        "robot",
        "what the intra-option policies see: the robot's own observation, the same free of place and heading (ego), "
        "or everything",
        code="everything",
        ours="robot: as HiPPO's skills",
        choices=("robot", "ego", "full"),
    )
    initialisation: str = setting(
        "glorot",
        "initial weights: Glorot-uniform, or normc (norm one per output, 0.01 in the last layer of a policy)",
        code="normc",
        ours="glorot: as all methods",
        choices=("glorot", "normc"),
    )
    log_std_per_skill: bool = setting(
        False,
        "one log-std vector per option instead of a shared one",
        code="per option",
        ours="shared: as in the skills that all methods are given",
    )
    skills: str = setting(
        "",
        "skills file that the intra-option policies start from; empty: from scratch",
        paper="from scratch; given skills in Fig. 6",
    )
    manager_hidden_sizes: list[int] = setting(
        [32, 32], "hidden layers of the policy over options", paper="2 x 32 (manager, App. A)", low=1, high=WIDEST
    )
    termination_hidden_sizes: list[int] = setting(
        [32, 32],
        "hidden layers of the terminations",
        code="a head on the critic's 2 x 64",
        ours="a manager's",
        low=1,
        high=WIDEST,
    )
    critic_hidden_sizes: list[int] = setting([64, 64], "hidden layers of the critic", code="2 x 64", low=1, high=WIDEST)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skill_observation == "ego" and self.observation_filter and not self.skills:
            valid = "turns observations as they are: needs observation_filter=false"
            raise ConfigError("skill_observation", "ego", valid)

    def check_environment(self, robot: str, options: dict[str, Any], layout: Any = None) -> None:
        """Refuse a view that an environment of gym:<id>, with a `layout`, has not."""
        check_view(self.skill_observation, layout)

    @property
    def scale(self) -> float:
        """Factor on the rewards; with one option this is PPO, unscaled."""
        return self.reward_scale if self.num_skills > 1 else 1.0

    @property
    def switching_cost(self) -> float:
        """Deliberation cost; with one option nothing is deliberated."""
        return self.deliberation_cost if self.num_skills > 1 else 0.0

    @property
    def steps_between_updates(self) -> int:
        """Steps per environment between updates."""
        return min(-(-self.steps_per_update // self.num_envs), self.horizon) or self.horizon
