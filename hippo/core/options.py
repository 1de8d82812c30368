"""Options (Sutton, Precup and Singh 1999) run by call-and-return: their networks, and how they are carried out.

An option is an intra-option policy pi(a|s, o) that goes on until its termination beta(s, o) fires in a state it arrives
at; then the policy over options pi_Omega(o|s) chooses the next. Q(s, o) values a state under the option in force.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hippo.core import seeding
from hippo.core.acting import OfHorizons
from hippo.core.networks import for_few_rows, mlp
from hippo.core.normalize import ObservationFilter
from hippo.core.policies import Manager, SkillPolicy, sample_categorical
from hippo.core.rollout import Steps


class OptionPolicy(nn.Module):
    """The networks of all options, each with a trunk of its own.

    Intra-option policies are the skill network of HiPPO and see the first `robot_size` entries of an observation
    (or what `skills.ego` makes of them); policy over options, terminations and critic see all of it.
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
        self.num_options = num_options
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


class Acting(OfHorizons):
    """Call-and-return in N environments (`hippo.core.acting.Acting`).

    With `greedy` every level takes its most likely choice: mean action, likeliest option, termination where its
    probability is above one half.
    """

    def __init__(
        self, policy: OptionPolicy, config: Any, num_envs: int, seed: int, iteration: int, greedy: bool = False
    ) -> None:
        self.policy, self.greedy = policy, greedy
        self._everywhere = np.arange(num_envs)
        self.skill = np.zeros(num_envs, np.int64)  # (N,) the option in force
        self.begins = np.ones(num_envs, bool)  # (N,) an episode begins with what is seen next
        super().__init__(config.horizon, seed, iteration)
        self._renew_networks()

    def _draw(self, seed: int, iteration: int) -> None:
        """T + 1 rows of what is decided before a step, T of what is added to actions."""
        purposes = ("skills", "manager", "termination")
        skills, manager, termination = (seeding.torch_generator(seed, purpose, iteration) for purpose in purposes)
        T, N = self._horizon, len(self._everywhere)
        shape = (T, N, self.policy.skills.log_std_parameter.shape[-1])
        self._noise = torch.randn(shape, generator=skills).numpy() * (not self.greedy)
        self._choice = torch.rand(T + 1, N, generator=manager).numpy()
        fire = torch.rand(T + 1, N, generator=termination)
        self._fire = (torch.full_like(fire, 0.5) if self.greedy else fire).log().numpy()  # compared with log beta

    def _renew_networks(self) -> None:
        policy = self.policy
        self._view, self._act = policy.filter.actor(), policy.skills.actor()
        self._logits, self._stop = policy.manager.actor(), for_few_rows(policy.termination)

    def renew(self, obs: np.ndarray) -> None:
        """Go on with the networks as they have become, and see `obs` (N, D) through their filter."""
        self._renew_networks()
        self._seen = self._view(obs)

    def decide(self, obs: np.ndarray) -> np.ndarray:
        """See `obs` (N, D), and go on with the option or choose one; returns where one was chosen, (N,) bool."""
        self._seen = self._view(obs)
        logit = self._stop(self._seen)[self._everywhere, self.skill]
        decides = self.begins | (self._fire[self._t] < -np.logaddexp(0, -logit))
        where = np.flatnonzero(decides)
        if len(where):
            logits = self._logits(self._seen[where])
            chosen = logits.argmax(-1) if self.greedy else sample_categorical(logits, self._choice[self._t][where])
            self.skill[where] = chosen
        return decides

    def action(self) -> np.ndarray:
        """What the options in force do (N, A) about what was last seen."""
        return self._act(self.policy.skills.see_array(self._seen), self.skill, self._noise[self._t])

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Decide and act."""
        self._next_horizon_if_over()
        self.decide(obs)
        return self.action()

    def end(self, done: np.ndarray) -> None:
        """One step has passed, and with it the episodes where `done` (N,)."""
        self.begins = done
        self._t += 1


class Execution:
    """One horizon of call-and-return, recorded in portions between which the policy may change.

    It starts from fresh episodes; all randomness is named by (seed, iteration).
    """

    def __init__(
        self, policy: OptionPolicy, config: Any, envs: Any, seed: int, iteration: int, greedy: bool = False
    ) -> None:
        T, N = config.horizon, envs.num_envs
        self.steps = Steps(envs, T)
        self.acting = Acting(policy, config, N, seed, iteration, greedy)
        shape = (T + 1, N)
        self.options = Options(
            torch.zeros(shape, dtype=torch.long),
            torch.zeros(shape, dtype=torch.bool),
            torch.zeros(shape, dtype=torch.bool),
        )
        # The same memory for numpy, whose small assignments cost a tenth of torch's.
        self._write = tuple(x.numpy() for x in (self.options.option, self.options.is_decision, self.options.begins))
        self._obs = self.steps.reset(seeding.integer(seed, "episodes", iteration))
        self._decide(0)

    def _decide(self, t: int) -> None:
        option, is_decision, begins = self._write
        begins[t] = self.acting.begins
        is_decision[t] = self.acting.decide(self._obs)
        option[t] = self.acting.skill

    @torch.no_grad()
    def run(self, first: int, last: int) -> None:
        """Take the steps first .. last - 1 with the policy as it is now."""
        self.acting.renew(self._obs)
        for t in range(first, last):
            self._obs, done = self.steps.step(t, self.acting.action())
            self.acting.end(done)
            self._decide(t + 1)
