"""Captures as files: JPEG with metadata, DNG, PNG, TIFF, and video through real encoders."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.scenes import Scene


def exif_block(scene: Scene) -> bytes:
    """EXIF data of a JPEG: make, model, orientation, exposure, ISO; begins with "Exif"."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = scene.make, scene.model, scene.orientation
    inner = exif.get_ifd(0x8769)
    inner[0x829A] = IFDRational(Fraction(scene.exposure_s).limit_denominator(1_000_000))
    inner[0x8827] = scene.iso
    return exif.tobytes()


def encode_jpeg(rgb: NDArray[np.uint8], scene: Scene) -> bytes:
    """A JPEG file of a developed picture.

    Args:
        rgb: (height, width, 3) uint8.
        scene: whose quality, subsampling and metadata are written.
    """
    import simplejpeg

    isp = scene.isp
    body = simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), isp.quality, "RGB", isp.subsampling, False)
    exif = exif_block(scene)
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    return bytes(body[:2] + segment + body[2:])


def write_png(rgb: NDArray[np.generic], path: Path) -> None:
    """Write a developed picture of 8 or 16 bits as PNG."""
    import cv2

    ok, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    assert ok, "PNG takes any picture of 8 or 16 bits"
    path.write_bytes(data.tobytes())
