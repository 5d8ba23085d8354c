"""Several processes that train one network, here on the CPU, against a single one."""

import csv
import dataclasses
import os
import socket
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.multiprocessing import set_start_method, spawn

from hm_sfm.errors import ConfigError, HmSfmError
from hm_sfm.training import loop
from hm_sfm.training.batches import iterate_batches
from hm_sfm.training.config import TrainConfig
from hm_sfm.training.loop import train
from hm_sfm.training.processes import Processes, find_processes

PROCESSES = 2


def find_port() -> int:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def run_rank(rank: int, folder: Path, ports: list[int], training: TrainConfig) -> None:
    """What one of the processes does: trainings of two stages, one that is interrupted, one whose loss is not finite.

    Leaves `folder`/<training>-<rank>.pt, the network at the end of each, and the error in error-<rank>.txt.
    """
    # As under torchrun; otherwise the processes that prepare the pairs would each load everything anew.
    set_start_method("fork", force=True)
    torch.set_num_threads(1)
    loop.HELD_OUT_PAIRS = 4
    loop.draw_curves = lambda log, validation, path: path.touch()
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(PROCESSES), "MASTER_ADDR": "localhost"}
    kept = {"make_state": loop.make_state, "train_step": loop.train_step, "measure_objective": loop.measure_objective}

    def run(name: str, resume: bool = False, **changed) -> None:
        states = []
        loop.make_state = lambda *arguments: states.append(kept["make_state"](*arguments)) or states[-1]
        os.environ["MASTER_PORT"] = str(ports.pop())
        assert train(dataclasses.replace(training, out=str(folder / name), **changed), resume, quiet=True).exists()
        torch.save(states[0].net.state_dict(), folder / f"{name}-{rank}.pt")

    def interrupt(state, *rest):
        if state.step == 2:
            raise KeyboardInterrupt
        return kept["train_step"](state, *rest)

    def spoil(*arguments):
        parts = kept["measure_objective"](*arguments)
        return parts | {"loss": parts["loss"] * torch.nan} if rank else parts

    run("coarse")
    loop.train_step = interrupt
    with pytest.raises(KeyboardInterrupt):
        run("again")
    loop.train_step = kept["train_step"]
    run("again", resume=True)
    run("joint", stage="joint")
    loop.measure_objective = spoil
    with pytest.raises(HmSfmError) as error:
        run("spoilt")
    (folder / f"error-{rank}.txt").write_text(str(error.value))


@pytest.fixture(scope="module")
def shared(request, tmp_path_factory) -> Path:
    """The folder of the trainings of run_rank."""
    return tmp_path_factory.mktemp("processes")


@pytest.fixture
def several(shared, training) -> TrainConfig:
    """A training of four steps of two pairs, which two processes have done, see run_rank."""
    training = dataclasses.replace(
        training, stage="coarse", steps=4, pairs_per_step=2, rendered_share=0.3, images=str(shared / "photos"),
        start_from=str(shared / "xfeat.pt"),
    )  # fmt: skip
    if not (shared / "photos").exists():
        here = Path(training.out).parent
        (here / "photos").rename(shared / "photos")
        (here / "xfeat.pt").rename(shared / "xfeat.pt")
        ports = [find_port() for _ in range(5)]
        spawn(run_rank, (shared, ports, training), nprocs=PROCESSES)
    return training


def read_losses(path: Path, name: str = "loss") -> list[float]:
    with path.open() as file:
        return [float(row[name]) for row in csv.DictReader(file)]


@pytest.mark.parametrize("name", ["coarse", "again", "joint"])
def test_all_processes_hold_the_same_weights(several, shared, name):
    first, second = (torch.load(shared / f"{name}-{rank}.pt") for rank in range(PROCESSES))
    assert all(torch.equal(value, second[key]) for key, value in first.items())


def test_they_train_as_one_process_does(several, shared):
    """The coarse stage: its loss is a mean over the pairs, and nothing in it depends on the other pairs."""
    path = train(several, quiet=True)
    for name in ("log.csv", "validation.csv"):
        assert len((shared / "coarse" / name).read_text().splitlines()) == len(
            path.with_name(name).read_text().splitlines()
        )
    for name in ("loss", "gradient"):
        expected = read_losses(path.with_name("log.csv"), name)
        np.testing.assert_allclose(read_losses(shared / "coarse" / "log.csv", name), expected, rtol=1e-3)
    alone = torch.load(path.with_name("checkpoint.pt"))["net"]
    before = loop.make_state(several, torch.device("cpu")).net.state_dict()
    for key, value in torch.load(shared / "coarse-1.pt").items():
        # Adam moves weights without a gradient worth the name by its sign: as far either way.
        moved = (alone[key] - before[key]).abs().max() if value.is_floating_point() else 0
        assert (value - alone[key]).abs().max() <= 0.1 * moved, key


def test_the_fine_stage_learns_from_all_processes(several, shared):
    """Its patches and batch norms depend on the number of processes, the loss of the coarse stage does not."""
    path = train(dataclasses.replace(several, stage="joint"), quiet=True)
    actual, expected = (read_losses(folder / "log.csv", "coarse") for folder in (shared / "joint", path.parent))
    assert actual[0] == pytest.approx(expected[0], rel=1e-4)
    actual, expected = (read_losses(folder / "log.csv") for folder in (shared / "joint", path.parent))
    np.testing.assert_allclose(actual, expected, rtol=0.2)
    before = loop.make_state(dataclasses.replace(several, stage="joint"), torch.device("cpu")).net.state_dict()
    after = torch.load(shared / "joint-0.pt")
    assert not torch.equal(before["backbone.fine.stem.1.running_mean"], after["backbone.fine.stem.1.running_mean"])


def test_an_interrupted_training_of_several_goes_on_to_the_same_curve(several, shared):
    for name in ("loss", "gradient", "rate"):
        assert read_losses(shared / "again" / "log.csv", name) == read_losses(shared / "coarse" / "log.csv", name)
    first, second = (torch.load(shared / f"{name}-0.pt") for name in ("coarse", "again"))
    assert all(torch.equal(value, second[key]) for key, value in first.items())


def test_a_loss_that_is_not_finite_in_one_process_stops_them_all(several, shared):
    for rank in range(PROCESSES):
        assert "the loss is nan at step 0" in (shared / f"error-{rank}.txt").read_text()
    assert not (shared / "spoilt" / "checkpoint.pt").exists()


def test_a_process_gets_its_share_of_every_step():
    pairs = [{"index": np.array(i), "b_from_a": np.zeros((1, 3, 3))} for i in range(20)]
    for count, rank, expected in (
        (1, 0, [[8, 9, 10, 11], [12, 13, 14, 15], [16, 17, 18, 19]]),
        (2, 1, [[10, 11], [14, 15], [18, 19]]),
    ):
        batches = iterate_batches(pairs, 4, 2, Processes(rank, count, rank))
        assert [batch["index"].tolist() for batch in batches] == expected


def test_without_torchrun_there_is_one_process(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    assert find_processes() == Processes(0, 1, 0)
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert find_processes().is_first
    alone = torch.ones(3)
    find_processes().average([alone])
    assert alone.tolist() == [1, 1, 1]


def test_the_environment_of_torchrun_is_read(monkeypatch):
    for name, value in (("RANK", "5"), ("WORLD_SIZE", "8"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    assert find_processes() == Processes(5, 8, 1)
    assert not find_processes().is_first
    monkeypatch.delenv("LOCAL_RANK")
    with pytest.raises(ConfigError, match="RANK='5', WORLD_SIZE='8', LOCAL_RANK=''"):
        find_processes()


def test_steps_that_cannot_be_shared_are_refused(training, monkeypatch):
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "3"), ("LOCAL_RANK", "0")):
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match="pairs_per_step must be a multiple of the 3 processes, found 4"):
        train(dataclasses.replace(training, pairs_per_step=4), quiet=True)
