"""Skills on disk: a pre-trained lower level, what it was trained for, and how a policy starts from it."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hippo.core import checkpoint
from hippo.core.checkpoint import CheckpointError
from hippo.core.policies import SkillPolicy
from hippo.core.view import Ego

METADATA = (
    "robot",
    "observation",
    "num_skills",
    "hidden_sizes",
    "integration",
    "log_std_per_skill",
    "obs_size",
    "action_size",
    "env",
    "algo",
    "run_id",
    "env_steps",
    "physics",
)


# What files of older code do not say: what skills see of the robot's observation ("robot": all), and its entries.
LATER = {"view", "names"}


class SkillsError(ValueError):
    """A skills file is missing, damaged, or for another robot, observation or network than the policy's."""


def network_of(policy: SkillPolicy) -> dict[str, Any]:
    """What has to agree between two skill networks for one to hold the other's weights."""
    linear = policy.rest.layers
    return {
        "num_skills": policy.num_skills,
        "hidden_sizes": [layer.in_features for layer in linear],
        "integration": policy.first.integration,
        "log_std_per_skill": len(policy.log_std_parameter) > 1,
        "action_size": linear[-1].out_features,
    }


def save_skills(path: Path, policy: SkillPolicy, metadata: dict[str, Any]) -> None:
    """Write `policy` and what it was trained for, in the format of checkpoints (SHA-256, no code).

    Args:
        metadata: the entries of METADATA, of which those that describe the network are taken from `policy`.

    Raises:
        SkillsError: an entry is missing.
    """
    content = metadata | network_of(policy) | {"obs_size": policy.first.inputs}
    for key in METADATA:
        if key not in content:
            raise SkillsError(f"{key}: missing in the metadata of {path}")
    checkpoint.save(Path(path), {"metadata": content, "policy": policy.state_dict()})


def read_skills(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Metadata and tensors of a skills file.

    Raises:
        SkillsError: there is no such file, it is no skills file, was cut short or altered.
    """
    try:
        content = checkpoint.load(Path(path))
        metadata = content["metadata"]
        return {key: metadata[key] for key in (*METADATA, *(LATER & metadata.keys()))}, content["policy"]
    except (OSError, CheckpointError) as error:
        raise SkillsError(f"skills={path}: {error}") from error
    except KeyError as error:
        raise SkillsError(f"skills={path}: not a skills file, it has no {error}") from error
    except (TypeError, AttributeError) as error:
        raise SkillsError(f"skills={path}: not a skills file ({error})") from error


def policy_of(path: Path) -> tuple[SkillPolicy, dict[str, Any]]:
    """The policy that a skills file holds, and its metadata."""
    metadata, tensors = read_skills(path)
    policy = SkillPolicy(
        metadata["obs_size"],
        metadata["num_skills"],
        metadata["action_size"],
        metadata["hidden_sizes"],
        torch.Generator(),
        metadata["integration"],
        metadata["log_std_per_skill"],
    )
    policy.load_state_dict(tensors)
    if view_of(metadata) == "ego":
        policy.ego = Ego(metadata["names"])
    return policy, metadata


def view_of(metadata: dict[str, Any]) -> str:
    """What the skills of a file see of the robot's observation: robot or ego."""
    return metadata.get("view", "robot")


def load_skills(path: Path, policy: SkillPolicy, robot: str, observation: str) -> dict[str, Any]:
    """Fill `policy` in place, so that mean and log-std of every skill are the file's; returns the metadata.

    A policy that also sees the time left, as last input, gets zero weights for it: its outputs do not depend on the
    time until it learns otherwise (ours; the authors' pre-trained skills only fit a fixed period).

    Args:
        robot, observation: whose observation `policy` sees, `envs.robot_name` and `envs.observation_variant`.

    Raises:
        SkillsError: the file cannot be read or does not fit; names what differs, the file's value and the wanted one.
    """
    metadata, tensors = read_skills(path)
    view = "robot" if policy.ego is None else "ego"
    wanted = {"robot": robot, "observation": observation, "view": view} | network_of(policy)
    for key, value in wanted.items():
        if (has := view_of(metadata) if key == "view" else metadata[key]) != value:
            raise SkillsError(f"skills={path}: its {key} is {has}, the policy's {value}")
    inputs = policy.first.inputs
    if inputs not in (metadata["obs_size"], metadata["obs_size"] + 1):
        raise SkillsError(
            f"skills={path}: its obs_size is {metadata['obs_size']}, the policy's {inputs} (one more is the time left)"
        )
    if inputs > metadata["obs_size"]:
        weight = with_blind_input(tensors["first.weight"], metadata["obs_size"], policy.num_skills)
        tensors = tensors | {"first.weight": weight}
    try:
        policy.load_state_dict(tensors)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise SkillsError(f"skills={path}: its tensors do not fit ({' '.join(str(error).split())[:200]})") from error
    return metadata


def with_blind_input(weight: Tensor, inputs: int, num_skills: int) -> Tensor:
    """First-layer weight (H, [x, z, x (x) z]) with a last entry of x added that has no effect, alone or times z."""
    x, z, products = weight.split([inputs, num_skills, weight.shape[1] - inputs - num_skills], 1)
    parts = [x, x.new_zeros(len(x), 1), z, products]
    if products.shape[1]:
        parts.append(x.new_zeros(len(x), num_skills))  # x major: the products of the last entry come last
    return torch.cat(parts, 1)


def start_from(skills: str, policy: SkillPolicy, envs: Any) -> None:
    """Fill the lower level `policy` from the file `skills` ("": leave it as drawn), for the robot of `envs`."""
    if skills:
        load_skills(Path(skills), policy, envs.robot_name, envs.observation_variant)
