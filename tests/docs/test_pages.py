"""docs/own_task.md and docs/use_policy.md, done."""

import sys

import gymnasium as gym
import numpy as np

import hippo
from tests.docs.pages import blocks, follow


def test_the_page_about_ones_own_task_does_what_it_says(tmp_path, monkeypatch, capsys):
    said = follow("own_task.md", tmp_path, monkeypatch, capsys)
    for env in ("hippo gym:Pendulum-v1", "ppo gym:InvertedPendulum-v5", "hippo gym:my_tasks:Cart-v0"):
        assert f"{env} seed 0  iteration 2/2" in said
    del gym.registry["Cart-v0"], sys.modules["my_tasks"]


def test_the_page_about_using_a_policy_does_what_it_says(tmp_path, monkeypatch, capsys):
    said = follow("use_policy.md", tmp_path, monkeypatch, capsys)
    assert "steps left\n" in said
    assert "\n1600 -" in said  # steps and a return of the Pendulum
    assert said.endswith("(4, 1)\n")
    policy = hippo.load(tmp_path / "policy")
    action, _ = policy.act(np.zeros(len(policy.task.observation_names)))
    assert policy.spaces[1].contains(action.astype(np.float32))


def test_training_from_a_script_takes_ten_lines():
    (code,) = [text for _, title, text in blocks("use_policy.md") if title == "train.py"]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
