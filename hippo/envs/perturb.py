"""Changes of the dynamics for Table 1: mass, damping, inertia or friction of named elements, multiplied.

`strength="original"` scales exactly what the authors' code scales (the first half of each of MuJoCo's arrays);
`strength="all"` (ours) scales every body, joint or geom by 1.5.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from hippo.envs.arguments import Refused

PERTURBATIONS = ("mass", "damping", "inertia", "friction")
STRENGTHS = ("original", "all")
ALL_FACTOR = 1.5


@dataclass(frozen=True)
class Change:
    """What the authors multiply: the elements' names and the factor."""

    elements: tuple[str, ...]
    factor: float


ANT_BODIES = ("torso", "front_left_leg", "aux_1", "foot_1", "front_right_leg", "aux_2")
WALLS = ("wall_east", "wall_west", "wall_north", "wall_south")
ORIGINAL = {
    "ant": {
        "mass": Change(ANT_BODIES, 1.5),
        "damping": Change(("root", "hip_1"), 1.5),
        "inertia": Change(ANT_BODIES, 1.3),
        "friction": Change(("floor", *WALLS, "torso", "aux_1", "leg_1", "ankle_1"), 1.5),
    },
    "snake": {
        "mass": Change(("torso", "mid"), 1.5),
        "damping": Change(("x", "y", "heading", "rot2"), 1.5),
        "inertia": Change(("torso", "mid"), 1.5),
        "friction": Change((WALLS[-1], "torso", "mid"), 1.5),
    },
}


def change_of(robot: str, quantity: str, strength: str, spec: mujoco.MjSpec) -> Change:
    """The elements and the factor of one perturbation.

    Raises:
        ValueError: the authors define no such change for this robot.
    """
    if strength == "original":
        if robot not in ORIGINAL:
            valid = f"defined for {', '.join(ORIGINAL)}, not for {robot}; use strength=all"
            raise Refused("strength", "original", valid)
        return ORIGINAL[robot][quantity]
    elements = {"mass": spec.bodies, "inertia": spec.bodies, "damping": spec.joints, "friction": spec.geoms}[quantity]
    names = tuple(e.name for e in elements if e.name != "world" and not e.name.startswith("block_"))
    return Change(names, ALL_FACTOR)


def perturb(spec: mujoco.MjSpec, robot: str, quantity: str, strength: str) -> None:
    """Multiply one quantity of `spec` in place, leaving every other one as compiled.

    Inertias that MuJoCo infers are zero in a spec, and scaling a density would scale mass and inertia together, so the
    compiled mass, centre and inertia are written out first.
    """
    change = change_of(robot, quantity, strength, spec)
    if quantity in ("mass", "inertia"):
        model = spec.compile()
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO  # explicit ones count
        for body in spec.bodies:
            compiled = model.body(body.name)
            if body.name == "world" or compiled.mass[0] == 0:
                continue
            body.explicitinertial = True
            body.mass = float(compiled.mass[0])
            body.ipos, body.iquat, body.inertia = compiled.ipos, compiled.iquat, compiled.inertia
    for name in change.elements:
        if quantity == "mass":
            spec.body(name).mass *= change.factor
        elif quantity == "inertia":
            spec.body(name).inertia = np.asarray(spec.body(name).inertia) * change.factor
        elif quantity == "damping":
            spec.joint(name).damping = np.asarray(spec.joint(name).damping) * change.factor
        else:
            spec.geom(name).friction = np.asarray(spec.geom(name).friction) * change.factor
