"""The settings of HIRO (baselines/hiro.py), each with its source."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from hippo.core.budget import BudgetConfig
from hippo.core.goals import BODY_GOALS, GOAL_SPACES
from hippo.core.settings import MOST_STEPS, WIDEST, ConfigError, setting


@dataclass
class HiroConfig(BudgetConfig):
    """The settings of HIRO."""

    iterations: int = setting(dataclasses.MISSING, "training iterations", ours="HIRO's own 10 M steps", low=1)
    batch_size: int = setting(
        dataclasses.MISSING,
        "environment steps per iteration",
        ours="one horizon of a few environments",
        low=1,
        high=MOST_STEPS,
    )
    period: int = setting(10, "c, steps between two goals", code="10 (ant_maze.gin:27)", low=1)
    goal_space: str = setting(
        "body",
        "what goals are about: the robot's pose (body), its place (xy), or both, x and y hidden from the lower level; "
        "of gym:<id> the entries of the observation, such as 0:2 or achieved_goal",
        paper="without access to ground-truth (x, y); with, in appendix D",
        code="both (hiro_orig.gin) and xy (hiro_xy.gin)",
    )
    position_range: float = setting(
        10.0,
        "half range of goals in x and y, m; of all goals of gym:<id>, in the unit of the entry",
        code="10 (hiro_xy.gin:6); the arena's is 6",
        above=0.0,
    )
    hidden_sizes: list[int] = setting(
        [300, 300], "two hidden layers (ReLU) of all networks", code="300, 300 (base_uvf.gin:34)", low=1, high=WIDEST
    )
    actor_learning_rate: float = setting(1e-4, "Adam step size of the actors", code="1e-4", above=0.0)
    critic_learning_rate: float = setting(1e-3, "Adam step size of the critics", code="1e-3", above=0.0)
    gamma: float = setting(
        0.99, "discount, per step and per decision", code="0.99 at both levels (train_uvf.gin:24)", above=0.0, high=1.0
    )
    tau: float = setting(
        0.005, "how far the targets move at a time", code="0.005 (base_uvf.gin:68)", above=0.0, high=1.0
    )
    delay: int = setting(2, "critic updates per update of actor and targets", code="2 (train_uvf.gin:27)", low=1)
    minibatch_size: int = setting(100, "transitions per update", code="100 (train_uvf.gin:22)", low=1)
    replay_size: int = setting(
        200_000, "rows of each level's replay buffer", code="200,000 (train_uvf.gin:3)", low=1, high=MOST_STEPS
    )
    warmup_steps: int = setting(
        2500, "environment steps before the first update", code="5 episodes of 500 (train_uvf.gin:21)", low=0
    )
    updates_per_step: float = setting(
        1.0, "updates of the lower level per environment step", code="1 (train_uvf.gin:28)", above=0.0
    )
    manager_update_every: int = setting(
        10, "updates of the lower level per update of the manager", code="10 (train_uvf.gin:30)", low=1
    )
    noise_units: str = setting(
        "range",
        "unit of the noise (1.0 exploration, 0.2 and 0.5 targets): 1/30 of an action's and 1/10 of a goal's half "
        "range, as published for torques of 30 and goals of 10 m (range), or 1 (absolute)",
        code="absolute (base_uvf.gin:64), with torques up to 30",
        choices=("range", "absolute"),
    )
    manager_reward_scale: float = setting(
        0.1, "factor on the rewards that the manager learns from", code="0.1 (train.py:192)", above=0.0
    )
    off_policy_correction: bool = setting(True, "relabel sampled decisions", code="yes (train.py:247)")
    ignore_terminals: bool = setting(
        False,
        "bootstrap where an episode ended for good, too",
        code="yes (train.py:520)",
        ours="no: the robots here can fall",
    )
    skills: str = setting(
        "",
        "skills file whose roll-outs the lower level is cloned from and both buffers start with; empty: from scratch",
        paper="fine-tunes the same given skills (Fig. 6), no recipe",
    )
    cloning_steps: int = setting(
        20_000, "environment steps of the roll-outs of given skills, at least", ours="no recipe", low=1
    )
    cloning_updates: int = setting(5000, "minibatches of behaviour cloning", ours="25 passes over the roll-outs", low=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.period > self.horizon:
            raise ConfigError("period", self.period, f"must be at most the horizon, {self.horizon} steps")
        if self.replay_size < self.minibatch_size:
            valid = f"must be at least the minibatch, {self.minibatch_size} transitions"
            raise ConfigError("replay_size", self.replay_size, valid)
        if len(self.hidden_sizes) != 2:
            raise ConfigError("hidden_sizes", self.hidden_sizes, "must be two layers")

    def check_environment(self, robot: str, options: dict[str, Any], layout: Any = None) -> None:
        """Refuse goals about entries that the environment's observation, of gym:<id> its `layout`, does not have."""
        if layout is not None:
            layout.find("goal_space", self.goal_space)
            return
        if self.goal_space not in GOAL_SPACES:
            raise ConfigError("goal_space", self.goal_space, f"must be one of {', '.join(GOAL_SPACES)}")
        if self.goal_space != "body" and not options.get("position", False):
            raise ConfigError("goal_space", self.goal_space, "needs env.position=true (Gather): no x, y are observed")
        if self.goal_space != "xy" and robot not in BODY_GOALS:
            raise ConfigError(
                "goal_space", self.goal_space, f"knows the pose of {', '.join(BODY_GOALS)}, not of {robot}"
            )
