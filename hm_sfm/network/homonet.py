"""The network as a whole: backbone, coarse stage and fine head."""

from torch import nn

from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.network.coarse import AspanCoarse, AttentionCoarse, CosineCoarse, LoftrCoarse
from hm_sfm.network.detector import KeypointDetector
from hm_sfm.network.fine import ExpectationHead, HomographyHead
from hm_sfm.network.lightglue import LightGlue
from hm_sfm.network.resnet import LoftrBackbone


class HomoNet(nn.Module):
    """Backbone, coarse stage and fine head, called one by one: features once per image, the rest per pair.

    Raises ConfigError where a size of the configuration is impossible.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        if config.window < 5 or (config.window - 1) & (config.window - 2):
            raise ConfigError(f"network.window must be 5, 9, 17 ..., found {config.window}")
        for field, least in (("radius", 0), ("iterations", 1), ("margin", 0)):
            if getattr(config, field) < least:
                raise ConfigError(f"network.{field} must be at least {least}, found {getattr(config, field)}")
        spacing = config.spacing
        if spacing < 1 or spacing & (spacing - 1) or spacing > (config.window - 1) // 2:
            raise ConfigError(
                f"network.spacing must be a power of 2 up to {(config.window - 1) // 2}, half of network.window, found "
                f"{spacing}"
            )
        light = config.backbone == "light"
        self.backbone = LightBackbone() if light else LoftrBackbone()
        if config.coarse == "attention":
            self.coarse = AttentionCoarse() if light else LoftrCoarse()
        elif config.coarse == "aspan":
            self.coarse = AspanCoarse(channels=64, heads=4, blocks=2) if light else AspanCoarse()
        else:
            self.coarse = CosineCoarse()
        if config.coarse == "context":
            if not light:
                raise ConfigError("network.coarse context matches descriptors of the light backbone: found loftr")
            self.detector = KeypointDetector()
            self.context = LightGlue()
        if config.head == "homography":
            self.head = HomographyHead(config.window, config.radius, config.iterations, config.margin, spacing)
        else:
            self.head = ExpectationHead(config.window, config.margin)
