"""Where the network computes, and whether in half precision."""

import torch

from hm_sfm.errors import ConfigError


def pick_device(name: str) -> torch.device:
    """The device `cpu`, `cuda`, or `auto`: CUDA where there is one. Raises ConfigError where CUDA is absent."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device cuda was asked for, but this PyTorch finds no CUDA GPU")
    return torch.device(name)


def autocast(device: torch.device) -> torch.autocast:
    """Half precision for convolutions and matrix products, where the processor computes it natively."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=computes_in_half(device))


def computes_in_half(device: torch.device) -> bool:
    """Whether half precision is faster than float32; fine features take 2 bytes a number then, not 4.

    A processor needs matrix units for that (AMX): with AVX512-BF16 alone, convolutions take a third longer in bf16.
    """
    if device.type == "cuda":
        return True
    # Whoever limits PyTorch to lesser instructions (ATEN_CPU_CAPABILITY=avx2) gets no AMX from it either.
    return torch.cpu._is_amx_tile_supported() and torch.backends.cpu.get_cpu_capability() == "AVX512"
