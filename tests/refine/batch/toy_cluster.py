"""Jobs of toys on a Dask cluster of two worker processes; run as a program, with a folder for their traces.

Dask's own warnings and threads stay out of the tests' process. Prints the outcomes as a line of JSON.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import dask
from distributed import LocalCluster

from refine.batch.cluster import work_on_cluster
from tests.refine.batch.toys import Toys

JOBS = ("one", "die once", "fail", "two", "three")


def main() -> None:
    dask.config.set({"distributed.comm.timeouts": {"connect": "600s", "tcp": "600s"}})  # on a busy machine
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        found = dict(work_on_cluster(Toys(Path(sys.argv[1])), JOBS, cluster.scheduler_address))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
