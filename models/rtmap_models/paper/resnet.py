"""ResNet-18 and ResNet-50 whose parameters are named as torchvision names them.

A state dict of torchvision's ``resnet18`` or ``resnet50`` that the user brings therefore loads
(`load_backbone`); its classifier ``fc`` is left out. As there, ResNet-50 strides in the 3×3
convolution of a bottleneck. Normalisation is a choice of the configuration: "batch" learns its
statistics (training from scratch), "frozen" keeps those that were loaded and their affine weights
(fine-tuning with few images per step, as MapTR and its descendants do).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_cli.errors import BadInput
from rtmap_models.tensors import read_tensors

BLOCKS = {"resnet18": (2, 2, 2, 2), "resnet50": (3, 4, 6, 3)}

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of red, green and blue in 0 … 1, as torchvision's weights expect them."""


class FrozenNorm(nn.BatchNorm2d):
    """Batch normalisation that never learns: neither its statistics nor its weights."""

    def __init__(self, channels: int):
        super().__init__(channels)
        self.requires_grad_(False)
        super().train(False)

    def train(self, mode: bool = True) -> FrozenNorm:
        """Stays in evaluation mode."""
        return super().train(False)


Norm = type[nn.BatchNorm2d]


def _conv(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with a shortcut."""

    expansion = 1

    def __init__(self, inputs: int, width: int, stride: int, norm: Norm):
        super().__init__()
        self.conv1, self.bn1 = _conv(inputs, width, 3, stride), norm(width)
        self.conv2, self.bn2 = _conv(width, width, 3), norm(width)
        self.downsample = _shortcut(inputs, width, stride, norm)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) → (B, width, h / stride, w / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class Bottleneck(nn.Module):
    """1×1, 3×3 and 1×1 convolutions with a shortcut."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int, norm: Norm):
        super().__init__()
        outputs = width * self.expansion
        self.conv1, self.bn1 = _conv(inputs, width, 1), norm(width)
        self.conv2, self.bn2 = _conv(width, width, 3, stride), norm(width)
        self.conv3, self.bn3 = _conv(width, outputs, 1), norm(outputs)
        self.downsample = _shortcut(inputs, outputs, stride, norm)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) → (B, 4 · width, h / stride, w / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


def _shortcut(inputs: int, outputs: int, stride: int, norm: Norm) -> nn.Sequential | None:
    if inputs == outputs and stride == 1:
        return None
    return nn.Sequential(_conv(inputs, outputs, 1, stride), norm(outputs))


class ResNet(nn.Module):
    """Normalised images → the maps of the last three stages.

    ``base`` is the width of the stem; torchvision's is 64, others cannot take its weights.
    """

    def __init__(self, kind: str, norm: str = "batch", base: int = 64):
        super().__init__()
        block: type[BasicBlock | Bottleneck] = BasicBlock if kind == "resnet18" else Bottleneck
        make: Norm = FrozenNorm if norm == "frozen" else nn.BatchNorm2d
        self.conv1 = nn.Conv2d(3, base, 7, 2, 3, bias=False)
        self.bn1 = make(base)
        inputs = base
        for stage, count in enumerate(BLOCKS[kind]):
            width = base * 2**stage
            blocks = []
            for k in range(count):
                stride = 2 if stage > 0 and k == 0 else 1
                blocks.append(block(inputs, width, stride, make))
                inputs = width * block.expansion
            self.add_module(f"layer{stage + 1}", nn.Sequential(*blocks))
        self.widths = (inputs // 4, inputs // 2, inputs)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, 3, H, W) → (B, widths[k], H/s, W/s) at strides s = 8, 16, 32.

        Every stride centres cell i of its output on cell 2 i of its input: cell i of a map of
        stride s lies at pixel s · i, not in the middle of its s pixels.
        """
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        x8 = self.layer2(self.layer1(x))
        x16 = self.layer3(x8)
        return x8, x16, self.layer4(x16)


def normalize_images(images: Tensor) -> Tensor:
    """uint8 RGB (..., H, W, 3) → float (..., 3, H, W) as torchvision's weights expect it."""
    mean = torch.tensor(IMAGE_MEAN, device=images.device) * 255.0
    std = torch.tensor(IMAGE_STD, device=images.device) * 255.0
    return ((images.float() - mean) / std).movedim(-1, -3)


def load_backbone(network: nn.Module, path: Path) -> None:
    """Load a torchvision state dict of the same ResNet into every ResNet of ``network``.

    The file may hold the state dict itself or have it under ``state_dict`` or ``model``. BadInput
    when the file is missing or damaged, when names or shapes do not fit, or when the network has
    no image backbone. Nothing but tensors is read (``weights_only``).
    """
    path = Path(path)
    targets = [m for m in network.modules() if isinstance(m, ResNet)]
    if not targets:
        raise BadInput(path, "this configuration has no ResNet", "leave --backbone out")
    state = _read_state(path)
    for target in targets:
        own = target.state_dict()
        for name, value in own.items():
            if name not in state and not name.endswith("num_batches_tracked"):
                raise BadInput(path, f"no tensor {name}", "give the ResNet of the configuration")
            if name in state and state[name].shape != value.shape:
                have, need = tuple(state[name].shape), tuple(value.shape)
                todo = "give the ResNet of the configuration"
                raise BadInput(path, f"{name} is {have}, not {need}", todo)
        if odd := sorted(k for k in state if k not in own and not k.startswith("fc.")):
            raise BadInput(path, f"unknown tensor {odd[0]}", "give the ResNet of the configuration")
        target.load_state_dict({k: state.get(k, v) for k, v in own.items()})


def _read_state(path: Path) -> dict[str, Tensor]:
    todo = "give a state dict of torchvision's ResNet"
    content = read_tensors(path, "a state dict", todo, "save it with torch.save")
    for key in ("state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    if not isinstance(content, dict) or not all(isinstance(v, Tensor) for v in content.values()):
        raise BadInput(path, "not a state dict: it must map names to tensors", "save it anew")
    if not all(bool(torch.isfinite(v).all()) for v in content.values()):
        raise BadInput(path, "a tensor is not finite", "give other weights")
    return content
