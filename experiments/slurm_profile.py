"""What every Slurm job of a sweep asks for: conf/slurm/default.yaml, or a copy of it."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from experiments.choices import CONF, nearest
from hippo.core.settings import ConfigError, check, setting

YEAR = 365 * 24 * 60  # minutes
# What Slurm's own names and expressions are made of, and nothing that ends a line or a word of the script.
TEXT = re.compile(r"[\w.,:@+*&|()\[\]-]+")
OPTION = re.compile(r"--[a-z][a-z-]*(=[^\s'\"\\`$]+)?")  # of sbatch, as it stands in a script
NAMES = ("partition", "account", "constraint", "qos", "gres", "exclude", "mail")
# What other keys say, or the launcher itself: jobs are arrays of one task that are told to stop and requeued.
NOT_EXTRA = {
    *("partition", "account", "constraint", "qos", "gres", "exclude", "mail-user", "mail-type"),
    *("time", "mem", "cpus-per-task", "signal", "job-name", "array", "dependency", "output", "error", "open-mode"),
    *("requeue", "no-requeue", "nodes", "ntasks", "ntasks-per-node", "wckey", "wrap", "parsable", "test-only", "wait"),
}


@dataclass
class Profile:
    """What a job asks for."""

    partition: str | None = setting(None, "partition, null for the cluster's default")
    account: str | None = setting(None, "account")
    constraint: str | None = setting(None, "constraint on nodes, e.g. a CPU model")
    qos: str | None = setting(None, "quality of service")
    gres: str | None = setting(None, "generic resources, e.g. gpu:1; training needs none")
    exclude: str | None = setting(None, "nodes never to be used, e.g. node[3-5]")
    mail: str | None = setting(None, "address that is told when an array has ended or failed")
    time_minutes: int = setting(
        240, "time limit of a job; two at least, for the signal may come a minute early", low=2, high=YEAR
    )
    memory_gb: float = setting(2.0, "memory of a job", low=0.1, high=100_000)
    cpus: int = setting(1, "CPUs of a job", low=1, high=10_000)
    parallel: int = setting(100, "jobs of one array that may run at the same time", low=1, high=10_000)
    group_minutes: int = setting(60, "short runs share a job of about this length; 0: a job each", low=0, high=YEAR)
    signal_seconds: int = setting(60, "seconds before the limit at which a job is told to stop", low=10, high=65_535)
    setup: list[str] | None = setting(None, "lines of shell before the job: modules, conda, variables")
    python: str | None = setting(None, "what starts Python on a node where it is not this one: a container")
    extra: list[str] | None = setting(None, "more options of sbatch, verbatim: --licenses=x, --exclusive")

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if name in ("setup", "extra"):
                self._check_lines(name, value)
            elif name == "python":
                self._check_lines(name, None if value is None else [value])
            elif name in NAMES:
                if value is not None and not (isinstance(value, str) and TEXT.fullmatch(value)):
                    valid = f"must be null or text of letters, digits and {TEXT.pattern}"
                    raise ConfigError(f"profile {name}", repr(value), valid)
            elif isinstance(value, bool) or not isinstance(value, (int, float) if field.type is float else int):
                kind = "a number" if field.type is float else "a whole number"
                raise ConfigError(f"profile {name}", repr(value), f"must be {kind}")
        check(self)
        for option in self.extra or ():
            if not OPTION.fullmatch(option):
                valid = "must be --name or --name=value, without blanks, quotes, $ and backslashes"
                raise ConfigError("profile extra", repr(option), valid)
            if option[2:].partition("=")[0] in NOT_EXTRA:
                raise ConfigError("profile extra", option, "is what a key of the profile, or the launcher itself, says")
        if self.signal_seconds >= 60 * self.time_minutes:
            limit = f"must be below the time limit, {self.time_minutes} minutes"
            raise ConfigError("profile signal_seconds", self.signal_seconds, limit)

    @staticmethod
    def _check_lines(name: str, lines: Any) -> None:
        """Refuse what is not a list of lines of text."""
        if lines is None:
            return
        if not isinstance(lines, list):
            raise ConfigError(f"profile {name}", repr(lines), "must be null or a list of lines")
        for line in lines:
            if not isinstance(line, str) or not line.strip() or not line.replace("\t", " ").isprintable():
                raise ConfigError(f"profile {name}", repr(line), "must be one line of text")

    @property
    def options(self) -> dict[str, Any]:
        """What submitit is told, apart from what the launcher decides."""
        names = {f"slurm_{key}": value for key in NAMES if key != "mail" and (value := getattr(self, key)) is not None}
        mail = {} if self.mail is None else {"slurm_mail_user": self.mail, "slurm_mail_type": "END,FAIL"}
        return names | mail

    @property
    def extra_options(self) -> dict[str, Any]:
        """`extra` as submitit takes it: a flag is True."""
        parts = (option[2:].partition("=") for option in self.extra or ())
        return {name: value if equals else True for name, equals, value in parts}

    def __str__(self) -> str:
        """In one line, and one more for each line of `setup`, `python` and `extra`."""
        asked = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        lines = {name: asked.pop(name) for name in ("setup", "python", "extra")}
        lines["python"] = lines["python"] and [lines["python"]]
        words = ", ".join(f"{name} {value}" for name, value in asked.items() if value is not None)
        return "\n".join([words, *(f"  {name}: {line}" for name, of in lines.items() for line in of or ())])


def load_profile(path: Path | None) -> Profile:
    """Read a profile, by default conf/slurm/default.yaml.

    Raises:
        ConfigError: no such file, no such key, a value out of range.
    """
    path = CONF / "slurm" / "default.yaml" if path is None else path
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError("profile", path, f"must be a yaml file ({' '.join(str(error).split())})") from error
    valid = [f.name for f in dataclasses.fields(Profile)]
    if not isinstance(content, dict):
        raise ConfigError("profile", path, f"must set some of {', '.join(valid)}")
    for key in content:
        if key not in valid:
            raise ConfigError(f"profile {key}", content[key], nearest(str(key), valid))
    return Profile(**content)
