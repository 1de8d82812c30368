"""Value functions: the single baseline V(s) and the skill-conditioned baseline V(s, z, time left) of section 4.2.

Two hidden layers of 32 ReLU units, inputs and target standardised with the statistics of the batch they are fitted to,
as in the authors' code (GaussianMLPRegressor). Departure, *ours*: the authors minimise a Gaussian likelihood by L-BFGS
under a KL trust region; here it is the mean squared error by plain L-BFGS, warm-started at the last iteration's
weights and limited to a number of loss evaluations, which bounds the cost of an iteration.
"""

import contextlib
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hippo.core.networks import SkillLinear, grouped_layers, linear, mlp, normalize_columns
from hippo.core.normalize import Standardizer
from hippo.core.optimizers import LBFGS
from hippo.core.ppo import chunks, in_chunks


class _BudgetSpent(Exception):
    """Leaves L-BFGS in the middle of a line search once all loss evaluations are used."""


class ValueFunction(nn.Module):
    """V(x), or V(x, z) where `num_skills` is given.

    Either it is fitted, and predicts zero until it has been once; or, `in_loop`, an optimiser trains it by `output` and
    it predicts that. With skills the first layer's input is [x, z, x (x) z], where x already holds the remaining time.

    Args:
        initialisation: "glorot" or "normc", as in `OnPolicyConfig`.
    """

    def __init__(
        self,
        input_size: int,
        hidden_sizes: Sequence[int],
        generator: torch.Generator,
        num_skills: int = 0,
        initialisation: str = "glorot",
        in_loop: bool = False,
    ) -> None:
        super().__init__()
        self.num_skills = num_skills
        self.first: nn.Linear | SkillLinear
        if num_skills:
            self.first = SkillLinear(input_size, num_skills, hidden_sizes[0], "bilinear", generator)
        else:
            self.first = linear(input_size, hidden_sizes[0], generator)
        after_first = mlp([*hidden_sizes, 1], generator, nn.ReLU)
        self.rest, self._layers = nn.Sequential(nn.ReLU(), after_first), after_first.layers
        if initialisation == "normc":
            normalize_columns(self.layers, 1.0, generator)
        self.inputs, self.target = Standardizer(input_size), Standardizer(1)
        self.is_fitted: Tensor
        self.register_buffer("is_fitted", torch.tensor(in_loop))

    @property
    def layers(self) -> "list[nn.Linear | SkillLinear]":
        """The layers in order; between them are rectifiers."""
        return [self.first, *self._layers]

    def output(self, x: Tensor, skill: Tensor | None = None) -> Tensor:
        """Values of rows sorted by skill, in the units of what the network is trained on: (B, D), (B,) -> (B,)."""
        if isinstance(self.first, SkillLinear):
            assert skill is not None
            counts, first = torch.bincount(skill, minlength=self.num_skills).tolist(), self.first.effective()
        else:
            counts, first = [len(x)], (self.first.weight.unsqueeze(0), self.first.bias.unsqueeze(0))
        return grouped_layers(x, counts, *first, self._layers, nn.ReLU).squeeze(-1)

    def _sorted(self, x: Tensor, skill: Tensor | None) -> tuple[Tensor, Tensor | None, Tensor | None]:
        if not self.num_skills:
            return x, None, None
        if skill is None:
            raise ValueError("this value function is conditioned on the skill: pass the skill of every row")
        order = skill.argsort(stable=True)
        return x[order], skill[order], order

    def predict(self, x: Tensor, skill: Tensor | None = None) -> Tensor:
        """Values: (..., D) and, with skills, (...) -> (...) in float64, without gradients."""
        shape, x = x.shape[:-1], x.reshape(-1, x.shape[-1])
        if not self.is_fitted or not len(x):
            return torch.zeros(shape, dtype=torch.float64)
        rows, sorted_skill, order = self._sorted(x, None if skill is None else skill.reshape(-1))

        def part(c: slice) -> Tensor:
            return self.output(self.inputs(rows[c]), None if sorted_skill is None else sorted_skill[c])

        value = in_chunks(part, len(rows))
        if order is not None:
            value = torch.empty_like(value).index_copy_(0, order, value)
        return self.target.invert(value.double()).reshape(shape)

    def fit(self, x: Tensor, target: Tensor, evaluations: int, skill: Tensor | None = None) -> float:
        """Regress on `target`: (B, D), (B,) and, with skills, (B,).

        Args:
            evaluations: the most loss-and-gradient evaluations that may be used; the best weights seen are kept.

        Returns:
            The standardised mean squared error of the kept weights (0 is perfect, 1 is the batch mean).
        """
        self.inputs.fit(x)
        self.target.fit(target.unsqueeze(-1))
        rows, sorted_skill, order = self._sorted(x, skill)
        if order is not None:
            target = target[order]
        rows = self.inputs(rows)
        goal = self.target(target.unsqueeze(-1).double()).squeeze(-1).to(rows.dtype)
        parameters = list(self.parameters())
        best_loss, best = float("inf"), [p.detach().clone() for p in parameters]
        used = 0

        def closure() -> float:
            nonlocal best_loss, used
            if used == evaluations:
                raise _BudgetSpent
            used += 1
            for p in parameters:
                p.grad = None
            total = 0.0
            for c in chunks(len(rows)):
                prediction = self.output(rows[c], None if sorted_skill is None else sorted_skill[c])
                loss = (prediction - goal[c]).square().sum() / len(rows)
                loss.backward()
                total += float(loss.detach())
            if total < best_loss:
                best_loss = total
                for kept, p in zip(best, parameters, strict=True):
                    kept.copy_(p.detach())
            return total

        optimizer = LBFGS(
            parameters, max_iter=evaluations, max_eval=evaluations, history_size=10, line_search_fn="strong_wolfe"
        )
        with contextlib.suppress(_BudgetSpent):
            optimizer.step(closure)
        with torch.no_grad():
            for kept, p in zip(best, parameters, strict=True):
                p.copy_(kept)
                p.grad = None
        self.is_fitted.fill_(True)
        return best_loss


def explained_variance(prediction: Tensor, target: Tensor) -> float:
    """1 - Var(target - prediction) / Var(target); 0 where the target does not vary."""
    variance = target.var(correction=0)
    if variance == 0:
        return 0.0
    return float(1 - (target - prediction).var(correction=0) / variance)
