"""A batch on a Dask cluster of two workers, one of which is killed while it has work; run as a program.

`python -m tests.e2e.local_cluster ARGUMENT ...` runs `refine` with these arguments on the cluster and prints
a line of JSON: its exit code, and how many photos the killed worker had.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time

import dask
from distributed import LocalCluster

import refine.cli


def kill_one(cluster: LocalCluster, finished: threading.Event, held: list[int]) -> None:
    """Wait until a worker has work, and kill it."""
    while not finished.is_set():
        for state in list(cluster.scheduler.workers.values()):
            nanny = next(n for n in cluster.workers.values() if n.worker_address == state.address)
            if state.processing and nanny.pid is not None:
                held.append(len(state.processing))
                os.kill(nanny.pid, signal.SIGKILL)
                return
        time.sleep(0.01)


def main() -> None:
    held: list[int] = []
    finished = threading.Event()
    patience = dict.fromkeys(("connect", "tcp"), "600s")  # on a busy machine, workers begin late
    dask.config.set({"distributed.comm.timeouts": patience})
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        killer = threading.Thread(target=kill_one, args=(cluster, finished, held))
        killer.start()
        code = refine.cli.run([*sys.argv[1:], "--engine", "dask", "--scheduler", cluster.scheduler_address])
        finished.set()
        killer.join()
    print(json.dumps({"code": code, "held": held}))


if __name__ == "__main__":
    main()
