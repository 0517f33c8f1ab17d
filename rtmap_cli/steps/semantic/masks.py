"""What each pixel shows: label PNGs beside the images, as classes of the ground."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.steps.semantic.labels import UNKNOWN, Labels

Mask = NDArray[np.uint8]


class Masks(Protocol):
    """Where masks come from."""

    def read(self, frame: Frame, camera: Camera) -> Mask | None:
        """(h, w) classes (`IGNORE` for what is no ground) of one image, None without one; h / w
        may be a fraction of the image's."""
        ...


class MaskFolder:
    """Label PNGs ``FOLDER/<camera>/<frame>.png`` (six digits), or named as the image file.

    Values are numbers of the label list, 8 or 16 bits, grey or with a palette. BadInput when the
    folder holds none, or masks of a camera that the log does not have.
    """

    def __init__(self, folder: Path, labels: Labels, rig: Rig) -> None:
        self.folder, self.labels = folder, labels
        if not folder.is_dir():
            raise BadInput(
                folder, "no such folder of masks", "give --masks DIR, or --segmenter MODEL.onnx"
            )
        cameras = {p.parent.name for p in folder.glob("*/*.png")}
        known = {c.name for c in rig}
        if not cameras:
            raise BadInput(folder, "holds no masks", "they are <camera>/<frame>.png in it")
        if unknown := cameras - known:
            raise BadInput(
                folder / min(unknown), "the log has no calibration of this camera",
                f"it has {', '.join(sorted(known))}",
            )  # fmt: skip
        self._tables = {size: labels.lookup(size) for size in (1 << 8, 1 << 16)}

    def path_of(self, frame: Frame, camera: str) -> Path | None:
        """The mask of one image, None without one."""
        names = [f"{frame.index:06d}.png"]
        if camera in frame.images:
            names.append(frame.images[camera].stem + ".png")
        return next((p for n in names if (p := self.folder / camera / n).is_file()), None)

    def read(self, frame: Frame, camera: Camera) -> Mask | None:
        """See `Masks`; BadInput when a mask is broken, has another size than the image or holds a
        number that the label list does not have."""
        path = self.path_of(frame, camera.name)
        if path is None:
            return None
        numbers = decode_mask(path)
        if numbers.shape != (camera.height, camera.width):
            h, w = numbers.shape
            raise BadInput(
                path, f"is {w}×{h}, its camera's images are {camera.width}×{camera.height}",
                "give masks of the images' size",
            )  # fmt: skip
        classes: Mask = self._tables[1 << 8 * numbers.dtype.itemsize].take(numbers)
        if (classes == UNKNOWN).any():
            number = int(numbers[classes == UNKNOWN][0])
            raise BadInput(
                path, f"label {number} is not in {self.labels.path} ({len(self.labels)} labels)",
                "give the list that the masks were made with: --labels",
            )  # fmt: skip
        return classes


def decode_mask(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """(H, W) label numbers of a PNG, uint8 or uint16; BadInput when it is none."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            kind, values = image.mode, np.asarray(image)
    except FileNotFoundError:
        raise BadInput(path, "no such mask") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(path, f"cannot be read as a mask ({text})", "write it again") from None
    if kind in ("L", "P", "1"):
        return values.astype(np.uint8)
    if kind in ("I;16", "I"):
        if values.min() < 0 or values.max() >= 1 << 16:
            raise BadInput(path, "holds numbers beyond 16 bits")
        return values.astype(np.uint16)
    raise BadInput(
        path, f"is a picture of mode {kind}, not label numbers", "write one 8-bit number per pixel"
    )
