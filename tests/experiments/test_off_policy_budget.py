"""HIRO's budget is one number of environment steps, whatever the horizon, and is counted alike by all who count."""

import pytest

from experiments.config import COMMITTED, compose_run
from experiments.plan import make_plan
from paper_figures import curves
from tests.analysis.test_same_place import learning_curves

TASKS = ("block_hopper", "block_half_cheetah", "snake_gather", "ant_gather")


@pytest.mark.parametrize(("scale", "steps"), [("paper", 10_000_000), ("laptop", 1_000_000), ("smoke", 4000)])
@pytest.mark.parametrize("env", TASKS)
def test_hiro_takes_the_steps_that_its_scale_says_in_every_environment(env, scale, steps):
    assert compose_run([f"env={env}", "algo=hiro", f"scale={scale}"]).env_steps == steps


def test_a_horizon_that_does_not_divide_the_batch_makes_smaller_batches_and_more_of_them():
    config = compose_run(["env=snake_gather", "algo=hiro"]).config  # 10 000 hold one horizon of 8000
    assert (config.num_envs, config.batch_size, config.iterations) == (1, 8000, 1250)
    config = compose_run(["env=snake_gather", "algo=hiro", "env.horizon=3000"]).config  # and three of 3000
    assert (config.num_envs, config.batch_size, config.iterations) == (3, 9000, 1112)
    config = compose_run(["env=ant_gather", "algo=hiro", "env.horizon=20000"]).config
    assert (config.num_envs, config.batch_size, config.iterations) == (1, 20_000, 500)


def test_what_is_typed_counts():
    run = compose_run(["env=block_hopper", "algo=hiro", "iterations=7", "batch_size=3000"])
    assert (run.config.iterations, run.config.batch_size, run.env_steps) == (7, 3000, 21_000)
    run = compose_run(["env=snake_gather", "algo=hiro", "batch_size=16000"])  # the steps stay
    assert (run.config.iterations, run.env_steps) == (625, 10_000_000)


def test_a_picture_counts_the_steps_that_are_taken(tmp_path):
    plan = make_plan("fig6", "laptop", [], True, tmp_path).within(["snake_gather"])
    runs = [entry.as_planned() for entry in plan.entries]
    budget = curves.budgets(learning_curves("snake_gather", {}, runs), "snake_gather")
    assert budget["hiro"] == budget["hiro_scratch"] == 1_000_000
    assert budget["hippo_p10"] == 200 * 13 * 8000  # 100 000 a batch, up to whole horizons


def test_no_committed_run_was_renamed(tmp_path):
    for figure in ("fig3", "fig4", "fig6"):
        planned = {entry.run.run_id for entry in make_plan(figure, "laptop", [], False, tmp_path).entries}
        rows = (COMMITTED / "laptop" / f"{figure}.csv").read_text().splitlines()[1:]
        assert {row.split(",")[5] for row in rows} <= planned
