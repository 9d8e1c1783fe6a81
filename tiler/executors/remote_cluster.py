"""Workers of a Dask cluster that is running already: connection, and check of its workers."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

from dask import config as settings
from dask.utils import parse_timedelta
from distributed import Client
from distributed.utils import silence_logging_cmgr

from pipeline.data.errors import CityError
from tiler.config.config import Config
from tiler.engine.executor import Executor
from tiler.engine.task_limits import Limits
from tiler.executors.dask_executor import DaskExecutor
from tiler.executors.transport import NO_FILES, TlsFiles, check_answer, make_security
from tiler.executors.worker_requirements import Requirements, check_cluster, own_requirements, require_files
from tiler.objects.places import is_url
from tiler.pointclouds.clouds import find_clouds

TCP_TIMEOUT = "distributed.comm.timeouts.tcp"
PATIENCE = 120.0  # s that a link may be cut; Dask by itself gives it up after 30 s


@contextmanager
def connect_run(config: Config) -> Iterator[Executor]:
    """Connect to the scheduler of a run, and compare its workers with this process.

    Parameters
    ----------
    config : Config
        Parameters of the run, its folder held.

    Raises
    ------
    CityError
        As `connect` and `tiler.executors.worker_requirements.require_files`; nothing is left in the folder.
    """
    clouds = find_clouds(config.pointcloud) if config.pointcloud else []
    given = [str(path) for path in (*clouds, *config.building_files, *config.terrain)]
    files = [Path(path) for path in given if not is_url(path)]
    # Who reaches a bucket reaches the same one, and its first task fails if it does not.
    with (
        nullcontext(own_requirements())
        if is_url(config.out)
        else require_files(Path(config.out).absolute(), files) as requirements,
        connect(
            config.scheduler,
            Limits(config.time_limit),
            tls=TlsFiles(config.tls_ca, config.tls_cert, config.tls_key),
            requirements=requirements,
        ) as executor,
    ):
        yield executor


@contextmanager
def connect(
    address: str,
    limits: Limits | None = None,
    *,
    tls: TlsFiles = NO_FILES,
    requirements: Requirements | None = None,
) -> Iterator[Executor]:
    """Run tasks on a Dask cluster whose workers see the same store and files; it is left running.

    Parameters
    ----------
    address : str
        Address of its scheduler, ``"tcp://10.0.0.1:8786"`` or ``"tls://10.0.0.1:8786"``.
    limits : Limits, optional
        The time limit holds if workers have one thread each; the memory limit is the cluster's own.
    tls : TlsFiles
        Files of TLS; those of Dask's configuration by default.
    requirements : Requirements, optional
        What its workers must meet; their versions alone by default.

    Raises
    ------
    CityError
        If nothing answers there, or it has no workers.
    ConfigError
        If it cannot be reached that way, or a worker does not meet the requirements: see
        `tiler.executors.transport` and `tiler.executors.worker_requirements`.

    Notes
    -----
    A worker that dies is not replaced: the others take its tasks. A lost scheduler ends the run with a
    `ClusterError`, and so does a cluster that has had no worker for `NO_WORKERS` seconds. A link to the scheduler
    that is cut is lost after `PATIENCE`, or what Dask's configuration has for it if that is more.
    """
    security = make_security(address, tls)
    check_answer(address, security)
    requirements = requirements or own_requirements()
    patience = max(parse_timedelta(settings.get(TCP_TIMEOUT)), PATIENCE)
    with ExitStack() as stack:
        stack.enter_context(settings.set({TCP_TIMEOUT: f"{patience:g}s"}))
        try:
            client = Client(address, security=security)
        except (OSError, RuntimeError) as error:
            raise CityError(
                f"{address}: no Dask scheduler answers ({error}); start one, or check the address"
            ) from error
        # We report a lost scheduler, once.
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))
        stack.enter_context(client)
        threads = list(client.nthreads().values())
        if not threads:
            raise CityError(f"{address}: the scheduler has no workers; start some and run again")
        check_cluster(client, address, requirements)
        seconds = limits.seconds if limits is not None and max(threads) == 1 else 0.0
        yield DaskExecutor(client, sum(threads), Limits(seconds), requirements=requirements)
