"""The learners by name, and where their code is; those of the baselines are in the checkout, not in the package."""

import importlib
from typing import Any

# name -> (module, config class); a module holds the config, REVISION, train, restored and Acting
LEARNERS = {
    "hippo": ("hippo.hippo", "HippoConfig"),
    "ppo": ("baselines.ppo", "PPOConfig"),
    "hier_vpg": ("baselines.hier_vpg", "HierVPGConfig"),
    "snn": ("baselines.snn", "SNNConfig"),
    "diayn": ("baselines.diayn", "DIAYNConfig"),
    "mlsh": ("baselines.mlsh", "MLSHConfig"),
    "option_critic": ("baselines.option_critic", "OptionCriticConfig"),
    "hiro": ("baselines.hiro", "HiroConfig"),
}


def learner_of(name: str) -> Any:
    """The module of a learner, imported when it is needed."""
    return importlib.import_module(LEARNERS[name][0])


def config_class(name: str) -> Any:
    """The config dataclass of a learner."""
    return getattr(learner_of(name), LEARNERS[name][1])
