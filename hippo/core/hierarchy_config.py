"""The settings of every learner with a manager and skills."""

from dataclasses import dataclass
from typing import Any

from hippo.core.on_policy import OnPolicyConfig
from hippo.core.settings import MOST_SKILLS, WIDEST, ConfigError, setting
from hippo.core.view import check_view


@dataclass
class HierarchyConfig(OnPolicyConfig):
    """What every algorithm that trains a hierarchy sets beside the rest: commitment, networks and what levels see.

    The defaults are the paper's and, where it is silent, the authors' code's.
    """

    num_skills: int = setting(
        6, "number of skills n", paper="6 (App. A)", code="6 (pg_test.py:332)", low=1, high=MOST_SKILLS
    )
    period_min: int = setting(
        5, "shortest commitment in steps; equal to period_max: a fixed period", paper="5 (App. A)", low=1
    )
    period_max: int = setting(15, "longest commitment in steps, inclusive", paper="15 (App. A)", low=1)
    skill_baseline: str = setting(
        "skill",
        "baseline of the skills: V(s, z, time left), the manager's V(s), or none",
        paper="skill-dependent (section 4.2, Fig. 4)",
        code="-sbl",
        choices=("skill", "single", "none"),
    )
    manager_baseline: str = setting(
        "single",
        "baseline of the manager: V(s) or none",
        paper="single (section 4.2)",
        choices=("single", "none"),
    )
    manager_advantage: str = setting(
        "step",
        "advantage of a decision: the per-step advantage where it is made, or semi-Markov GAE; equal for lambda 1",
        code="step (hippo2.py:186)",
        choices=("step", "smdp"),
    )
    manager_hidden_sizes: list[int] = setting(
        [32, 32], "manager's hidden layers", paper="2 x 32 (App. A)", low=1, high=WIDEST
    )
    skill_hidden_sizes: list[int] = setting(
        [64, 64], "skill network's hidden layers", paper="2 x 64 (App. A)", low=1, high=WIDEST
    )
    skill_integration: str = setting(
        "bilinear",
        "how the skill enters the skill network",
        code="bilinear (pg_test.py:157)",
        choices=("bilinear", "concatenate"),
    )
    skill_observation: str = setting(
        "robot",
        "what skills see: the robot's own observation, the same free of place and heading (ego), or everything",
        paper="pi(a|s, z), silent",
        code="robot (test2_hier_snn_mlp_policy.py:180)",
        choices=("robot", "ego", "full"),
    )
    log_std_per_skill: bool = setting(
        False, "one log-std vector per skill instead of a shared one", code="shared (test2_hier_snn_mlp_policy.py:226)"
    )
    skills: str = setting(
        "",
        "skills file that the lower level starts from; empty: from scratch",
        paper="from scratch; given skills in Fig. 6",
        code="-snnp, a pickle (test2_hier_snn_mlp_policy.py:122)",
    )
    truncate_to_period: bool = setting(
        False,
        "do not learn from the steps of an episode after its last whole period, as the authors with fixed p",
        code="yes for fixed p (hier_batch_sampler.py:36)",
        ours="no: it hides about 90 % of the Ant's falls at p = 10",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.period_min > self.period_max:
            raise ConfigError("period_min", self.period_min, f"must be at most period_max={self.period_max}")
        if self.truncate_to_period and self.period_min < self.period_max:
            raise ConfigError("truncate_to_period", True, "needs a fixed period (period_min = period_max)")
        if self.skills and self.normalize_observations:
            valid = "is a file of skills that see observations as they are: needs normalize_observations=false"
            raise ConfigError("skills", self.skills, valid)
        if self.skill_observation == "ego" and self.normalize_observations:
            valid = "turns observations as they are: needs normalize_observations=false"
            raise ConfigError("skill_observation", "ego", valid)

    def check_environment(self, robot: str, options: dict[str, Any], layout: Any = None) -> None:
        """Refuse a view that an environment of gym:<id>, with a `layout`, has not."""
        check_view(self.skill_observation, layout)
