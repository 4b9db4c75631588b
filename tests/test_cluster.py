"""The same dataset from a Dask cluster, also where a worker is killed."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from evnlos import EvnlosError
from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import simulate
from evnlos.data.pool import run_on_dask
from evnlos.machine import Step

distributed = pytest.importorskip("distributed", reason='needs the extra "cluster"')
pytestmark = pytest.mark.filterwarnings("ignore")


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.h5"))}


def test_a_killed_worker_costs_nothing_but_time(tiny, tiny_dataset, tmp_path) -> None:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        engine = partial(run_on_dask, scheduler=cluster.scheduler_address)
        made = []

        def kill_a_worker(step: Step) -> None:
            if step.done == 1:
                os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
            if step.result:
                made.append(step.result)

        simulate(tiny, tmp_path / "d", engine=engine, progress=kill_a_worker)
    assert sorted(made) == sorted(tiny_dataset.objects())
    assert bytes_of(tmp_path / "d") == bytes_of(tiny_dataset.folder)


def test_the_command_starts_a_cluster_of_its_own(tiny, tiny_dataset, tmp_path, capsys) -> None:
    save_yaml(tiny, tmp_path / "tiny.yaml")
    arguments = ["simulate", "--config", tmp_path / "tiny.yaml", "--out", tmp_path / "d", "--engine", "dask"]
    main([str(argument) for argument in [*arguments, "--workers", 1]])
    assert "0 missing" in capsys.readouterr().out
    assert bytes_of(tmp_path / "d") == bytes_of(tiny_dataset.folder)


def test_a_scheduler_that_is_not_there_is_one_line(tiny, tmp_path, monkeypatch) -> None:
    import dask

    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", lambda address, **_: client(address, timeout=3.0))
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(EvnlosError, match="answer"),
    ):
        next(run_on_dask(str, [1], scheduler="tcp://127.0.0.1:1"))


def test_a_scheduler_without_dask_is_refused(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["simulate", "--out", str(tmp_path / "d"), "--scheduler", "tcp://node:8786"])
    assert "--engine dask" in capsys.readouterr().err
