"""Pictures as bytes of an image file."""

import io

import cv2
import numpy as np
from PIL import Image


def encode_picture(pixels: np.ndarray, ending: str) -> bytes:
    """(H, W) grey or (H, W, 3) BGR uint8 as an image file of the kind of `ending`: .jpg, .jpeg, .png or .webp."""
    if ending == ".png":
        # Not by OpenCV: where pycolmap was imported before it, as scripts may do, its PNG encoder ends the process.
        file = io.BytesIO()
        Image.fromarray(pixels if pixels.ndim == 2 else pixels[:, :, ::-1]).save(file, "PNG", compress_level=1)
        return file.getvalue()
    return cv2.imencode(ending, pixels)[1].tobytes()
