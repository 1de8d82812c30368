"""Goals that a manager sets and a lower level is paid for reaching, and the memory that both learn from (HIRO)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hippo.core.replay import Replay

# What a goal without position is about, and the half range of the goal box: the Ant's of hiro_orig.gin without x and y,
# the others' ours (half of a joint's range; heights 0.5 m, pitch 1 rad; the Snake's of h-baselines).
LEG = (0.5, 0.3)  # hip, ankle
BODY_GOALS: dict[str, dict[str, float]] = {
    "ant": {"z": 0.5, **{f"quat_{i}": 1.0 for i in "wxyz"}}
    | {f"{joint}_{leg}": LEG[joint == "ankle"] for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")},
    "snake": dict.fromkeys(("heading", "rot2", "rot3", "rot4", "rot5"), 0.785),
    "hopper": {"z": 0.5, "pitch": 1.0, "thigh": 1.309, "leg": 1.309, "foot": 0.785},
    "half_cheetah": {"z": 0.5, "pitch": 1.0}
    | {"bthigh": 0.785, "bshin": 0.785, "bfoot": 0.593, "fthigh": 0.85, "fshin": 1.035, "ffoot": 0.5},
}
GOAL_SPACES = ("body", "xy", "both")  # of the robots here
POSITION = ("position_x", "position_y")  # what env.position=true appends to an observation
NEAREST = 1e-10  # under the root of the distance, as in the code
NUM_DRAWN = 8  # candidate goals drawn around the change that was achieved


@dataclass
class Goals:
    """Which entries of an observation goals are about, (k,) indices, and their box +-half_range (k,)."""

    index: Tensor
    half_range: Tensor

    @classmethod
    def of(cls, space: str, position_range: float, robot: str, observation_names: list[str]) -> "Goals":
        """Goals about the robot's pose ("body"), its place ("xy", +-position_range m) or both, in that observation."""
        ranges: dict[str, float] = {}
        if space != "body":
            ranges |= dict.fromkeys(POSITION, position_range)
        if space != "xy":
            ranges |= BODY_GOALS[robot]
        return cls(torch.tensor([observation_names.index(n) for n in ranges]), torch.tensor([*ranges.values()]))

    @classmethod
    def about(cls, entries: list[int], half_range: float) -> "Goals":
        """Goals about these entries of an observation, each within +-half_range."""
        return cls(torch.tensor(entries), torch.full((len(entries),), half_range))

    def of_state(self, obs: Tensor) -> Tensor:
        """S(s): (..., D) -> (..., k)."""
        return obs[..., self.index]

    def transition(self, obs: Tensor, goal: Tensor, next_obs: Tensor) -> Tensor:
        """S(s) + g - S(s'): what remains of a goal (..., k) after a step."""
        return self.of_state(obs) + goal - self.of_state(next_obs)

    def reward(self, obs: Tensor, goal: Tensor, next_obs: Tensor) -> Tensor:
        """- |S(s) + g - S(s')|, (...)."""
        return -(self.transition(obs, goal, next_obs).square().sum(-1) + NEAREST).sqrt()

    def clip(self, goal: Tensor) -> Tensor:
        """The nearest goals within the box."""
        return torch.minimum(torch.maximum(goal, -self.half_range), self.half_range)


def candidate_goals(goals: Goals, first: Tensor, last: Tensor, goal: Tensor, generator: torch.Generator) -> Tensor:
    """(B, 10, k) goals within the box: the stored, the change achieved, and 8 draws N(change, (half range / 2)^2).

    The stored goal comes first, so that it is kept where nothing explains the actions better.
    """
    change = (goals.of_state(last) - goals.of_state(first)).unsqueeze(1)
    noise = torch.randn((len(goal), NUM_DRAWN, goal.shape[1]), generator=generator)
    return goals.clip(torch.cat([goal.unsqueeze(1), change, change + 0.5 * goals.half_range * noise], 1))


class Memory:
    """The replay buffers of both levels, and the decisions that are still going on in N environments.

    Args:
        size: rows of each buffer. shape: steps per decision, entries of an observation, an action and a goal.
        reward_scale: of what the manager learns from. ignore_terminals: nothing ever ends for good.
    """

    def __init__(
        self,
        size: int,
        num_envs: int,
        shape: tuple[int, int, int, int],
        reward_scale: float = 1.0,
        ignore_terminals: bool = False,
    ) -> None:
        c, D, A, k = shape
        scalars: dict[str, tuple[int, ...]] = {"reward": (), "continues": ()}
        self.low = Replay(size, obs=(D,), goal=(k,), action=(A,), next_obs=(D,), next_goal=(k,), **scalars)
        self.manager = Replay(size, obs=(c + 1, D), action=(c, A), goal=(k,), length=(), **scalars)
        self.scale, self.ignores_terminals = reward_scale, ignore_terminals
        self.obs, self.action = torch.zeros(num_envs, c + 1, D), torch.zeros(num_envs, c, A)
        self.goal, self.reward = torch.zeros(num_envs, k), torch.zeros(num_envs)
        self.age = torch.zeros(num_envs, dtype=torch.long)  # steps since the decision

    def add(self, row: dict[str, Tensor], reward: Tensor, is_over: Tensor) -> None:
        """Take in a step of every environment.

        Args:
            row: a row of the lower level's buffer per environment, with "continues" as the environment has it.
            reward: (N,) the environment's. is_over: (N,) bool, the decision ended with this step.
        """
        if self.ignores_terminals:
            row["continues"] = torch.ones_like(row["continues"])
        self.low.add(**row)
        envs = torch.arange(len(self.age))
        begins = self.age == 0
        self.goal[begins], self.reward[begins] = row["goal"][begins], 0.0
        self.obs[begins], self.action[begins] = 0.0, 0.0
        self.obs[envs, self.age], self.action[envs, self.age] = row["obs"], row["action"]
        self.reward += self.scale * reward.to(self.reward.dtype)
        self.age += 1
        if is_over.any():
            self.obs[is_over, -1] = row["next_obs"][is_over]
            self.manager.add(
                obs=self.obs[is_over],
                action=self.action[is_over],
                goal=self.goal[is_over],
                length=self.age[is_over],
                reward=self.reward[is_over],
                continues=row["continues"][is_over],
            )
            self.age[is_over] = 0

    def abandon(self) -> None:
        """Forget decisions that are going on, because the environments start afresh."""
        self.age[:] = 0

    @property
    def parts(self) -> dict[str, Replay]:
        """What a checkpoint holds."""
        return {"low_replay": self.low, "manager_replay": self.manager}
