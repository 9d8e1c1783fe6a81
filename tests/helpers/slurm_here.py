"""A SLURM of four nodes on this machine: munged, slurmctld and four slurmd, without systemd and control groups."""

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from tests.helpers.loopback import free_ports

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
PATH = f"{os.environ['PATH']}{os.pathsep}/usr/sbin{os.pathsep}/sbin"
NODES = 4
CPUS, MEMORY = 8, 6000  # of each node, as SLURM shall believe; MiB

SETTINGS = """
ClusterName=here
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=0,sched_interval=2,bf_interval=2
ReturnToService=2
SlurmdTimeout=15
KillWait=5
MinJobAge=600
PartitionName=city Nodes=node[1-4] Default=YES LLN=YES MaxTime=INFINITE State=UP
"""
NODE = "NodeName=node{k} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={cpus} RealMemory={memory}\n"


@dataclass
class Slurm:
    """A SLURM at work; `environment` is for whoever talks to it."""

    folder: Path  #: settings, state and logs
    environment: dict[str, str]  #: that of this process, with the settings' path
    nodes: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)  #: the slurmd of each node

    def ask(self, *words: str) -> str:
        """Run one of SLURM's commands; returns what it prints."""
        done = subprocess.run(words, env=self.environment, capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def states(self) -> dict[str, str]:
        """State of each job that is known still, by its number."""
        rows = self.ask("squeue", "--noheader", "--states=all", "--format=%i %T").splitlines()
        return dict(row.split() for row in rows)

    def jobs_on(self, node: str) -> list[str]:
        """Numbers of the jobs that run on a node."""
        return self.ask("squeue", "--noheader", "--states=running", f"--nodelist={node}", "--format=%A").split()

    def node_of(self, job: str) -> str:
        """Node of a job that runs; empty of any other."""
        return self.ask("squeue", "--noheader", "--states=running", f"--jobs={job}", "--format=%N").strip()

    def start(self, command: list[str], name: str) -> "subprocess.Popen[bytes]":
        """Start a process whose words go to a file."""
        with (self.folder / f"{name}.txt").open("ab") as words:
            return subprocess.Popen(
                command, env=self.environment, stdout=words, stderr=words, start_new_session=True
            )

    def processes(self) -> list[psutil.Process]:
        """List all processes that were started with its settings, but this one."""
        ours = f"SLURM_CONF={self.environment['SLURM_CONF']}".encode()
        found = (process for process in psutil.process_iter() if ours in _environment(process))
        return [process for process in found if process.pid != os.getpid()]

    def processes_of(self, job: str) -> list[psutil.Process]:
        """List the processes of a job, by what SLURM puts into their environment, and their slurmstepd."""
        found = []
        for process in self.processes():
            with suppress(psutil.Error):
                title = " ".join(process.cmdline())
                if f"SLURM_JOB_ID={job}".encode() in _environment(process) or f"slurmstepd: [{job}." in title:
                    found.append(process)
        return found

    def kill_node(self, node: str) -> None:
        """Lose a node: its slurmd and every process of its jobs, at once."""
        slurmd = psutil.Process(self.nodes[node].pid)
        jobs = [one for job in self.jobs_on(node) for one in self.processes_of(job)]
        slurmd.kill()
        for process in jobs:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self.nodes[node].wait(30)

    def wait(self, look: Callable[[], bool], seconds: float, what: str) -> None:
        """Wait until something is so."""
        end = time.monotonic() + seconds
        while not look():
            assert time.monotonic() < end, f"{what}: not after {seconds:g} s; {self.states()}"
            time.sleep(0.3)


def skip_without_slurm() -> None:
    """Skip a test, saying so, where SLURM is not installed or this is not root."""
    missing = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
    if missing:
        pytest.skip(f"no {', '.join(missing)}: SLURM is not installed here (apt-get install slurm-wlm munge)")
    if os.geteuid() != 0:
        pytest.skip("not root: slurmd of several nodes cannot be started here")


@contextmanager
def slurm_here(folder: Path) -> Iterator[Slurm]:
    """Start a SLURM of four nodes in a folder; all its processes end with the context."""
    skip_without_slurm()
    host, ports = socket.gethostname().split(".")[0], free_ports(NODES + 1)
    text = SETTINGS.format(folder=folder, host=host, ports=ports)
    for k, port in enumerate(ports[1:], 1):
        text += NODE.format(k=k, host=host, port=port, cpus=CPUS, memory=MEMORY)
    settings, key = folder / "slurm.conf", folder / "munge.key"
    settings.write_text(text)
    (folder / "state").mkdir()
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    slurm = Slurm(folder, os.environ | {"SLURM_CONF": str(settings), "PATH": PATH})
    munge = ["munged", "--foreground", "--force", f"--key-file={key}", f"--socket={folder}/munge.socket"]
    munge += [f"--{name}-file={folder}/munge.{name}" for name in ("pid", "seed", "log")]
    with ExitStack() as stack:
        stack.callback(_end_all, slurm)
        stack.enter_context(_started(slurm, munge, "munged"))
        slurm.wait((folder / "munge.socket").exists, 30, "munged")
        stack.enter_context(_started(slurm, ["slurmctld", "-D"], "slurmctld"))
        stack.callback(_end_nodes, slurm)
        for node in (f"node{k}" for k in range(1, NODES + 1)):
            slurm.nodes[node] = slurm.start(["slurmd", "-D", "-N", node], node)
        slurm.wait(lambda: _count_idle(slurm) == NODES, 60, "idle nodes")
        yield slurm


def _count_idle(slurm: Slurm) -> int:
    done = subprocess.run(
        ["sinfo", "--noheader", "--Node", "--format=%t"],
        env=slurm.environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout.split().count("idle")


@contextmanager
def _started(slurm: Slurm, command: list[str], name: str) -> Iterator["subprocess.Popen[bytes]"]:
    process = slurm.start(command, name)
    try:
        yield process
    finally:
        _end(process)


def _end_nodes(slurm: Slurm) -> None:
    for process in slurm.nodes.values():
        _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait(20)


def _end_all(slurm: Slurm) -> None:
    """End what jobs have left, found by the settings that they were started with."""
    for _ in range(20):  # what is killed may just have started another one
        found = slurm.processes()
        if not found:
            return
        for process in found:
            with suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(found, timeout=5)


def _environment(process: psutil.Process) -> list[bytes]:
    """Read the environment of a process; psutil stops where slurmstepd has written its title."""
    try:
        return Path(f"/proc/{process.pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []
