"""Options (Sutton, Precup and Singh 1999) run by call-and-return: their networks, and how they are carried out.

An option is an intra-option policy pi(a|s, o) that goes on until its termination beta(s, o) fires in a state it arrives
at; then the policy over options pi_Omega(o|s) chooses the next. Q(s, o) values a state under the option in force.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from hippo.core.networks import for_few_rows, mlp
from hippo.core.normalize import ObservationFilter
from hippo.core.policies import Manager, SkillPolicy, sample_categorical
from hippo.core.rollout import Steps


class OptionPolicy(nn.Module):
    """The networks of all options, each with a trunk of its own.

    Intra-option policies are the skill network of HiPPO and see the first `robot_size` entries of an observation;
    policy over options, terminations and critic see all of it.
    """

    def __init__(
        self,
        obs_size: int,
        robot_size: int,
        action_size: int,
        num_options: int,
        skill_hidden_sizes: Sequence[int],
        manager_hidden_sizes: Sequence[int],
        termination_hidden_sizes: Sequence[int],
        critic_hidden_sizes: Sequence[int],
        generator: torch.Generator,
        skill_integration: str = "bilinear",
        log_std_per_skill: bool = False,
        termination_bias: float = 0.0,
    ) -> None:
        super().__init__()
        self.num_options, self.robot_size = num_options, robot_size
        self.filter = ObservationFilter(obs_size)
        self.skills = SkillPolicy(
            robot_size,
            num_options,
            action_size,
            skill_hidden_sizes,
            generator,
            skill_integration,
            log_std_per_skill,
        )
        self.manager = Manager(obs_size, num_options, manager_hidden_sizes, generator)
        self.termination = mlp([obs_size, *termination_hidden_sizes, num_options], generator)
        self.critic = mlp([obs_size, *critic_hidden_sizes, num_options], generator)
        last = self.termination[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.bias, termination_bias)

    def beta(self, seen: Tensor) -> Tensor:
        """Termination probability of every option: filtered observations (..., D) -> (..., K)."""
        return self.termination(seen).sigmoid()


@dataclass
class Options:
    """Which option was in force at every step of an iteration, and where it was chosen."""

    option: Tensor  # (T + 1, N)
    is_decision: Tensor  # (T + 1, N) bool, pi_Omega chose here: an episode begins or the last option terminated
    begins: Tensor  # (T + 1, N) bool, an episode begins here


class Execution:
    """Call-and-return in N environments for T steps, in portions between which the policy may change."""

    def __init__(
        self, policy: OptionPolicy, steps: Steps, generators: dict[str, torch.Generator], greedy: bool = False
    ) -> None:
        """Draws all randomness up front from the generators "skills", "manager" and "termination".

        With `greedy` every level takes its most likely choice: mean action, likeliest option, termination where its
        probability is above one half.
        """
        T, N, A = steps.action.shape
        self.policy, self.steps, self.greedy = policy, steps, greedy
        self._noise = torch.randn(T, N, A, generator=generators["skills"]).numpy() * (not greedy)
        self._choice = torch.rand(T + 1, N, generator=generators["manager"]).numpy()
        fire = torch.rand(T + 1, N, generator=generators["termination"])
        self._fire = (torch.full_like(fire, 0.5) if greedy else fire).log().numpy()  # compared with log beta
        shape = (T + 1, N)
        self.options = Options(
            torch.zeros(shape, dtype=torch.long),
            torch.zeros(shape, dtype=torch.bool),
            torch.zeros(shape, dtype=torch.bool),
        )
        # The same memory for numpy, whose small assignments cost a tenth of torch's.
        self._write = tuple(x.numpy() for x in (self.options.option, self.options.is_decision, self.options.begins))

    def start(self, seed: int) -> None:
        """A fresh episode, and an option, in every environment."""
        self._obs = self.steps.reset(seed)
        self._everywhere = np.arange(len(self._obs))
        self._option = np.zeros(len(self._obs), np.int64)
        self._refresh()
        self._arrive(0, np.ones(len(self._obs), bool))

    def _refresh(self) -> None:
        policy = self.policy
        self._view, self._act = policy.filter.actor(), policy.skills.actor()
        self._logits, self._stop = policy.manager.actor(), for_few_rows(policy.termination)

    def _arrive(self, t: int, begins: np.ndarray) -> None:
        """Go on with the option or choose one, in the state before step t."""
        self._seen = self._view(self._obs)
        logit = self._stop(self._seen)[self._everywhere, self._option]
        decides = begins | (self._fire[t] < -np.logaddexp(0, -logit))
        where = np.flatnonzero(decides)
        if len(where):
            logits = self._logits(self._seen[where])
            chosen = logits.argmax(-1) if self.greedy else sample_categorical(logits, self._choice[t][where])
            self._option[where] = chosen
        option, is_decision, is_begin = self._write
        option[t], is_decision[t], is_begin[t] = self._option, decides, begins

    @torch.no_grad()
    def run(self, first: int, last: int) -> None:
        """Take the steps first .. last - 1 with the policy as it is now."""
        self._refresh()
        self._seen = self._view(self._obs)
        robot = self.policy.robot_size
        for t in range(first, last):
            action = self._act(self._seen[:, :robot], self._option, self._noise[t])
            self._obs, done = self.steps.step(t, action)
            self._arrive(t + 1, done)
