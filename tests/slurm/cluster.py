"""A real one-node Slurm on loopback, without systemd, with everything it writes in one folder.

    python -m tests.slurm.cluster install    # Debian's packages, as root

Ports, sockets and state are its own, so it neither needs nor touches a Slurm that the machine may have.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil

PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
PORT = 18800
CPUS = 4  # claimed by the node; may be more than there are
NODE = "lab1"
PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"


def install() -> int:
    """Install the packages; their own services are never started."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    policy = Path("/usr/sbin/policy-rc.d")
    ours = not policy.exists()
    if ours:
        policy.write_text("#!/bin/sh\nexit 101\n")  # Debian's way to say that installing starts nothing
        policy.chmod(0o755)
    try:
        for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *PACKAGES]):
            if code := subprocess.run(["apt-get", *command], env=environment, check=False).returncode:
                return code
    finally:
        if ours:
            policy.unlink()
    return 0


def missing() -> list[str]:
    """Programs that are not installed."""
    return [name for name in ("slurmctld", "slurmd", "sbatch", "munged") if shutil.which(name, path=PATH) is None]


class Cluster:
    """The daemons of one cluster in `folder`, whose path must be short: a socket's may have 107 characters."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.socket = folder, folder / "munge" / "socket"
        self.configuration = folder / "slurm.conf"
        self.environment = {**os.environ, "PATH": PATH, "SLURM_CONF": str(self.configuration)}

    def run(self, *command: str, seconds: float = 30, check: bool = True) -> str:
        """Output of a command that talks to this cluster."""
        return subprocess.run(
            command, env=self.environment, cwd=self.folder, capture_output=True, text=True, timeout=seconds, check=check
        ).stdout

    def start(self) -> None:
        """Start munge, the controller and the node, and wait until the node is idle."""
        for name in ("munge", "state", "log", "spool"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        (self.folder / "munge").chmod(0o711)
        key = self.folder / "munge" / "key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        self.configuration.write_text(self.slurm_conf())
        names = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        self.run("munged", "--force", *(f"--{option}={self.folder / 'munge' / name}" for option, name in names.items()))
        self.run("slurmctld", "-f", str(self.configuration))
        self.start_node()
        self.until(lambda: self.run("sinfo", "-h", "-o", "%T", check=False).strip() == "idle", 30)

    def start_node(self) -> None:
        """Start the node's daemon."""
        self.run("slurmd", "-N", NODE, "-f", str(self.configuration))

    def stop_node(self) -> None:
        """Stop the node's daemon; its jobs go on."""
        self._end("slurmd.pid", signal.SIGTERM)

    def stop(self) -> None:
        """Cancel what runs and end every daemon."""
        self.run("scancel", "--user", str(os.getuid()), check=False)
        self.until(lambda: not self.run("squeue", "-h", check=False).strip(), 30, must=False)
        for name in ("slurmd.pid", "slurmctld.pid", "munge/pid"):
            self._end(name, signal.SIGTERM)

    def _end(self, pid_file: str, number: int) -> None:
        path = self.folder / pid_file
        if not path.exists():
            return
        try:
            process = psutil.Process(int(path.read_text()))
            process.send_signal(number)
            process.wait(20)
        except psutil.NoSuchProcess:
            pass
        except psutil.TimeoutExpired:
            process.kill()
        path.unlink(missing_ok=True)

    def until(self, condition, seconds: float, must: bool = True) -> None:
        """Wait for `condition`; on time-out show the daemons' logs."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                if must:
                    logs = "".join(p.read_text()[-2000:] for p in (self.folder / "log").glob("*.log"))
                    raise TimeoutError(f"not within {seconds} s\n{logs}")
                return
            time.sleep(0.2)

    def slurm_conf(self) -> str:
        """All on 127.0.0.1; quick to requeue (cred_expire) and to kill (KillWait), slow to forget (MinJobAge)."""
        host, user = socket.gethostname().split(".")[0], subprocess.getoutput("id -un")
        memory = psutil.virtual_memory().total // 2**20 * 9 // 10
        settings = {
            "ClusterName": "lab",
            "SlurmctldHost": f"{host}(127.0.0.1)",
            "SlurmctldPort": PORT,
            "SrunPortRange": f"{PORT + 50}-{PORT + 250}",
            "CommunicationParameters": "NoCtldInAddrAny,NoInAddrAny",
            "SlurmUser": user,
            "SlurmdUser": user,
            "AuthType": "auth/munge",
            "CredType": "cred/munge",
            "AuthInfo": f"socket={self.socket},cred_expire=5",
            "StateSaveLocation": self.folder / "state",
            "SlurmdSpoolDir": self.folder / "spool",
            "SlurmctldPidFile": self.folder / "slurmctld.pid",
            "SlurmdPidFile": self.folder / "slurmd.pid",
            "SlurmctldLogFile": self.folder / "log" / "slurmctld.log",
            "SlurmdLogFile": self.folder / "log" / "slurmd.log",
            "ProctrackType": "proctrack/linuxproc",
            "TaskPlugin": "task/none",
            "JobAcctGatherType": "jobacct_gather/none",
            "AccountingStorageType": "accounting_storage/none",
            "MpiDefault": "none",
            "SwitchType": "switch/none",
            "SchedulerType": "sched/backfill",
            "SchedulerParameters": "sched_interval=2,bf_interval=2,batch_sched_delay=0,sched_min_interval=0",
            "SelectType": "select/cons_tres",
            "SelectTypeParameters": "CR_Core",
            "SlurmdParameters": "config_overrides",
            "JobRequeue": 1,
            "ReturnToService": 2,
            "InactiveLimit": 0,
            "KillWait": 10,
            "MinJobAge": 86400,
            "MaxArraySize": 101,
            "FirstJobId": int(time.time()) % 60_000_000 + 1000,  # submitit finds old results under old job numbers
        }
        lines = [f"{key}={value}" for key, value in settings.items()]
        shape = f"CPUs={CPUS} Boards=1 SocketsPerBoard=1 CoresPerSocket={CPUS} ThreadsPerCore=1 RealMemory={memory}"
        lines += [
            f"NodeName={NODE} NodeAddr=127.0.0.1 NodeHostname={host} Port={PORT + 11} {shape} State=UNKNOWN",
            "PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE DefaultTime=60 State=UP",
        ]
        return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(install() if sys.argv[1:] == ["install"] else "usage: python -m tests.slurm.cluster install")
