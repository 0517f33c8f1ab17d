"""Camera images as a network wants them: scaled, undistorted, horizon on one row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.cameras import fit_camera, projection
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.log import Camera

Array = NDArray[np.float64]


class FittedCamera:
    """One camera fitted to a network's image size.

    ``ego_to_image`` (3, 4) float32 maps points of the ego frame dropped to the road (z = 0 on the
    road) to pixels of the fitted image.
    """

    def __init__(
        self, camera: Camera, size: tuple[int, int], horizon: float, ground_z: float
    ) -> None:
        self.camera, self.size = camera, size
        self.warp, self.intrinsics = fit_camera(
            camera.intrinsics,
            camera.ego_SE3_camera,
            (camera.height, camera.width),
            size,
            horizon,
        )
        self._road = np.eye(4)
        self._road[2, 3] = ground_z
        self._matrix = projection(self.intrinsics, camera.ego_SE3_camera)
        self.ego_to_image = (self._matrix @ self._road).astype(np.float32)
        self._lookup = None if camera.lens.straight else self._bent_lookup()

    def at(self, ego_SE3_exposure: Array | None) -> NDArray[np.float32]:
        """``ego_to_image`` (3, 4) for an image that was exposed while the ego frame stood at
        ``ego_SE3_exposure`` (4, 4) in the ego frame of the frame; None: at the frame's moment."""
        if ego_SE3_exposure is None:
            return self.ego_to_image
        matrix = self._matrix @ invert(ego_SE3_exposure) @ self._road
        return np.asarray(matrix, np.float32)

    def _bent_lookup(self) -> Array:
        """(H, W, 2) source pixels (x, y) of every fitted pixel under the camera's lens; far outside
        the image where the lens model means nothing."""
        height, width = self.size
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        fitted = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
        rays: Array = np.linalg.solve(self.intrinsics, fitted.T).T.astype(np.float64)
        pixels = self.camera.project(rays)
        return np.where(np.isnan(pixels), -1e6, pixels).reshape(height, width, 2)

    def load(self, path: Path) -> NDArray[np.uint8]:
        """Decode one image file and fit it: (H, W, 3) uint8 RGB, black where nothing was seen."""
        from PIL import Image, UnidentifiedImageError

        if not path.exists():
            raise BadInput(path, "no such image")
        try:
            with Image.open(path) as image:
                if image.size != (self.camera.width, self.camera.height):
                    raise BadInput(
                        path,
                        f"is {image.size[0]}×{image.size[1]}, the rig says "
                        f"{self.camera.width}×{self.camera.height}",
                        "correct rig.parquet or the images",
                    )
                # JPEG decodes at 1/2, 1/4, 1/8 for a fraction of the cost.
                image.draft("RGB", (self.size[1], 1))
                return self._fit(image.convert("RGB"))
        except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
            raise BadInput(
                path, f"cannot be read as an image ({error})", "pass --skip-bad-frames to go on"
            ) from None

    def _fit(self, image: Any) -> NDArray[np.uint8]:
        from PIL import Image

        height, width = self.size
        reduction = self.camera.width / image.size[0]
        if self._lookup is not None:
            scaled_height = max(1, round(self.camera.height * width / self.camera.width))
            small = np.asarray(image.resize((width, scaled_height), Image.Resampling.BILINEAR))
            ratio = np.array([width / self.camera.width, scaled_height / self.camera.height])
            return bilinear(small, (self._lookup + 0.5) * ratio - 0.5)
        scale, shift = self.warp[0, 0], self.warp[1, 2]
        # Rows [top, bottom) of the fitted image that the source covers.
        offset = shift - (0.5 * scale - 0.5)
        top = max(0, int(np.ceil(offset - 1e-6)))
        bottom = min(height, int(np.floor(offset + self.camera.height * scale + 1e-6)))
        out = np.zeros((height, width, 3), np.uint8)
        if bottom <= top:
            return out
        box = (0.0, (top - offset) / scale, float(self.camera.width), (bottom - offset) / scale)
        box = tuple(b / reduction for b in box)
        box = (0.0, max(box[1], 0.0), float(image.size[0]), min(box[3], float(image.size[1])))
        part = image.resize((width, bottom - top), Image.Resampling.BILINEAR, box=box)
        out[top:bottom] = np.asarray(part)
        return out


def bilinear(image: NDArray[np.uint8], at: Array) -> NDArray[np.uint8]:
    """Sample (h, w, 3) at pixels ``at`` (..., 2) as (x, y); black outside the image."""
    h, w = image.shape[:2]
    x, y = at[..., 0], at[..., 1]
    inside = (x >= -0.5) & (x <= w - 0.5) & (y >= -0.5) & (y <= h - 0.5)
    x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
    x0, y0 = np.minimum(x.astype(int), max(w - 2, 0)), np.minimum(y.astype(int), max(h - 2, 0))
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    value = np.rint(top * (1 - fy) + bottom * fy)
    return np.where(inside[..., None], value, 0).astype(np.uint8)
