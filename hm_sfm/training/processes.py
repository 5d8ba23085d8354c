"""The processes of one training: torchrun starts them, each takes an equal share of every step's pairs.

They hold the same weights: all start from the same seed and files, and step by the same averaged gradients.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

from hm_sfm.errors import ConfigError
from hm_sfm.network.device import pick_device

LONGEST_WAIT = timedelta(hours=2)
"""The others wait while the first process validates and saves."""


@dataclass(frozen=True)
class Processes:
    """Which of how many processes this one is."""

    rank: int = 0
    count: int = 1
    local_rank: int = 0
    """Among those of this machine: the number of its GPU."""

    @property
    def is_first(self) -> bool:
        """The first process alone writes files and validates."""
        return self.rank == 0

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace float32 tensors, the same list of shapes in all processes, by their means over the processes."""
        if self.count == 1 or not tensors:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        dist.all_reduce(flat)
        means = (flat / self.count).split([tensor.numel() for tensor in tensors])
        for tensor, mean in zip(tensors, means):
            tensor.copy_(mean.view(tensor.shape))


def find_processes() -> Processes:
    """What torchrun's environment says; a single process without it. Raises ConfigError where it is incomplete."""
    if os.environ.get("WORLD_SIZE", "1") == "1":
        return Processes()
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
    values = [os.environ.get(name, "") for name in names]
    if not all(value.isdecimal() for value in values):
        given = ", ".join(f"{name}={value!r}" for name, value in zip(names, values))
        raise ConfigError(f"several processes need the environment that torchrun sets, found {given}")
    return Processes(*map(int, values))


@contextmanager
def join_processes(processes: Processes, device_name: str) -> Iterator[torch.device]:
    """Give the device of this process; with several of them, they can average tensors within the block.

    device_name: auto | cpu | cuda. Raises ConfigError where the processes cannot find each other or their GPUs.
    """
    device = pick_device(device_name)
    if processes.count == 1:
        yield device
        return
    if device.type == "cuda":
        if processes.local_rank >= torch.cuda.device_count():
            raise ConfigError(
                f"process {processes.local_rank} of this machine has no GPU: there are {torch.cuda.device_count()}"
            )
        device = torch.device("cuda", processes.local_rank)
        torch.cuda.set_device(device)
    try:
        dist.init_process_group(
            "nccl" if device.type == "cuda" else "gloo",
            timeout=LONGEST_WAIT,
            rank=processes.rank,
            world_size=processes.count,
        )
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"the processes do not find each other: {' '.join(str(error).split())[:200]}") from error
    try:
        yield device
        # What the first process writes last is there when any of them goes on.
        dist.barrier()
    finally:
        dist.destroy_process_group()
