"""What HIRO's clone of given skills travels: what it is asked for, where its path ends, and the command."""

import numpy as np
import pytest
import torch

from experiments.artefacts import cloning
from hippo.core.goals import Goals


class Towards:
    """A lower level that moves by what remains of its goal."""

    def __init__(self, goals, period):
        self.goals = goals
        self.config = type("Config", (), {"period": period})()

    def act(self, obs, goal, noise):
        assert noise is None
        return goal


class Line:
    """Two points on a plane that move by their action; the second dies at its third step."""

    num_envs = 2

    def __init__(self):
        self.com = np.zeros((2, 3))

    def reset(self, seed):
        return self.com[:, :2].astype(np.float32), {}

    def step(self, action):
        self.com[:, :2] += action
        self.t = getattr(self, "t", 0) + 1
        after, terminated = self.com.copy(), np.array([False, self.t == 3])
        self.com[terminated] = 0.0  # the next episode begins
        return self.com[:, :2].astype(np.float32), None, terminated, np.zeros(2, bool), {"com": after}


def test_a_clone_is_asked_for_one_change_per_period_and_a_path_that_ended_stays_where_it_did():
    goals = Goals(torch.tensor([0, 1]), torch.tensor([10.0, 10.0]))
    wanted = torch.tensor([[[3.0, 0.0], [3.0, 0.0]], [[0.0, 4.0], [0.0, 4.0]]])  # in two periods of two steps
    # It takes the whole change in the first step of a period, and then asks for nothing more: (3, 0), then (3, 4).
    far = cloning.chased(Towards(goals, 2), Line(), wanted, 4, 0)
    assert far.tolist() == [5.0, 5.0]
    # The second point's episode ended at step 3, at (3, 4); its next one, from (0, 0), does not count.


def test_the_changes_that_a_path_achieved_are_those_of_its_periods_within_the_box():
    goals = Goals(torch.tensor([0, 1]), torch.tensor([0.25, 10.0]))
    place = torch.tensor([0.0, 0.1, 0.2, 0.6, 0.7, 0.8])  # 5 steps in periods of 2, 2 and 1
    seen = torch.stack([place, -place], -1).unsqueeze(1)
    paths = type("Paths", (), {"next_obs": seen[1:], "steps": type("Steps", (), {"obs": seen})()})()
    expected = torch.tensor([[[0.2, -0.2]], [[0.25, -0.5]], [[0.1, -0.1]]])
    torch.testing.assert_close(cloning.changes(goals, paths, 2), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["dog"], "robot=dog: valid: ant, snake, hopper, half_cheetah"), (["ant", "--paths", "3"], "paths=3: must be")],
)
def test_a_robot_or_number_that_cannot_be_is_refused_in_one_line(arguments, message, capsys):
    assert cloning.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_table_has_the_mean_and_each_skill():
    of = cloning.Distances(np.array([1.0, 3.0]), np.array([0.5, 0.5]), np.array([0.0, 1.0]), 0.72)
    assert cloning.line("ant", of) == "| ant | 2.00 (1.00 3.00) | 0.50 (0.50 0.50) | 0.50 (0.00 1.00) | 72% |"
