"""A small U-shaped convolutional network on the bird's-eye picture."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.bev import cell_centres
from rtmap_models.config import TinyConfig


def conv_block(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two 3×3 convolutions with a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1):
        super().__init__()
        self.first = conv_block(inputs, outputs, 3, stride)
        self.second = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False), nn.BatchNorm2d(outputs)
        )
        self.shortcut: nn.Module = nn.Identity()
        if inputs != outputs or stride != 1:
            self.shortcut = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) → (B, outputs, H / stride, W / stride)."""
        return F.relu(self.second(self.first(x)) + self.shortcut(x))


def _double(x: Tensor, like: Tensor) -> Tensor:
    """Twice as many cells per axis; the last ones are cut off where ``like`` has an odd number."""
    rows, columns = like.shape[2:]
    out = F.interpolate(x, scale_factor=2.0, mode="nearest")
    if (rows % 2, columns % 2) != (0, 0):
        out = out[:, :, :rows, :columns]
    return out


class PictureNet(nn.Module):
    """Normalised picture (B, K, H, W) → maps at stride 2 (fine) and stride 4 (coarse)."""

    position: Tensor

    def __init__(self, config: TinyConfig):
        super().__init__()
        c2, c4, c8, c16 = config.widths
        fine, coarse = config.fine_width, config.coarse_width
        self.down2 = conv_block(config.channels + 2, c2, 3, 2)
        self.down4 = nn.Sequential(conv_block(c2, c4, 3, 2), Residual(c4, c4))
        self.down8 = nn.Sequential(Residual(c4, c8, 2), Residual(c8, c8))
        self.down16 = nn.Sequential(Residual(c8, c16, 2), Residual(c16, c16))
        self.whole = nn.Conv2d(c16, c16, 1)
        self.lift8, self.mix8 = nn.Conv2d(c16, c8, 1), conv_block(c8, c8)
        self.lift4, self.mix4 = nn.Conv2d(c8, c4, 1), conv_block(c4, coarse)
        self.lift2, self.side2 = nn.Conv2d(coarse, fine, 1), nn.Conv2d(c2, fine, 1)
        self.mix2 = conv_block(fine, fine)
        position = cell_centres(1.0, 1.0, *config.picture_size).permute(2, 0, 1)[None]
        self.register_buffer("position", position.contiguous(), persistent=False)

    def forward(self, picture: Tensor, more: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Returns fine (B, fine_width, H/2, W/2) and coarse (B, coarse_width, H/4, W/4); ``more``,
        of the coarse map's shape, is added to it before the fine one is made of it."""
        position = self.position.to(picture.dtype).expand(picture.shape[0], -1, -1, -1)
        x = torch.cat([picture, position], dim=1)
        x2 = self.down2(x.contiguous(memory_format=torch.channels_last))
        x4 = self.down4(x2)
        x8 = self.down8(x4)
        x16 = self.down16(x8)
        x16 = F.relu(x16 + self.whole(x16.mean(dim=(2, 3), keepdim=True)))
        y8 = self.mix8(x8 + _double(self.lift8(x16), x8))
        y4 = self.mix4(x4 + _double(self.lift4(y8), x4))
        if more is not None:
            y4 = y4 + more.to(y4.dtype)
        y2 = self.mix2(self.side2(x2) + _double(self.lift2(y4), x2))
        return y2, y4
