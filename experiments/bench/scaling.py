"""How the cost of an environment step changes with environments, skills and batch; part of `make bench`."""

import statistics
from collections.abc import Iterator

from experiments.bench.iterations import Iteration, training
from experiments.bench.measure import Row, beside, contestants, one_core

ENV = "block_hopper"
STEPS = 20_000  # of an iteration, unless it is the batch that changes


def overrides(num_envs: int = 20, num_skills: int = 6, batch_size: int = STEPS) -> list[str]:
    """A HiPPO run of whole horizons."""
    horizon = batch_size // num_envs
    budget = [f"batch_size={horizon * num_envs}", f"env.horizon={horizon}", f"algo.num_skills={num_skills}"]
    return [f"env={ENV}", "algo=hippo", "scale=paper", *budget]


def cost(iteration: Iteration) -> float:
    """Microseconds of one environment step in a whole iteration."""
    return 1e6 / iteration.speed


def rows(quick: bool) -> Iterator[Row]:
    """Microseconds per environment step, and how many times the reference's, which is measured in between."""
    steps = STEPS // 4 if quick else STEPS
    batches = (10_000,) if quick else (10_000, 100_000, 400_000)
    cases = {
        "environments": (20, {n: overrides(n, batch_size=steps) for n in (20, 1, 5, 64, 256)}, 5),
        "skills": (6, {n: overrides(20, n, steps) for n in (6, 1, 24)}, 3),
        "batch": (50_000, {n: overrides(50, batch_size=n) for n in (50_000, *batches)}, 2),
    }
    for what, (basis, settings, rounds) in cases.items():
        with (
            one_core(),
            contestants({f"{what} {n:,}": (training, setting) for n, setting in settings.items()}) as turns,
        ):
            reference = turns.pop(f"{what} {basis:,}")
            measured = beside(lambda turn=reference: cost(turn()), turns, 1 if quick else rounds)  # type: ignore[misc]
        for label, results in measured.items():
            costs = [cost(iteration) for iteration, _ in results]
            ratio = statistics.median(c / basis_cost for c, (_, basis_cost) in zip(costs, results, strict=True))
            key = "scaling" if label == "environments 256" else ""
            yield Row(ENV, label, statistics.median(costs), "us/step", ratio, f"of {basis:,}", key)
