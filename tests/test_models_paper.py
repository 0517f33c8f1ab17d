"""The paper's network: its parts, its matching and losses, eight frames by heart, its export."""

from __future__ import annotations

import math
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra: train)")
cv2 = pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

from rtmap_models.architecture import build_network  # noqa: E402
from rtmap_models.cameras import project, read_maps  # noqa: E402
from rtmap_models.config import CONFIGS, PaperConfig, config_from_dict, load_config  # noqa: E402
from rtmap_models.data.dataset import Batch, Frame, collate, make_sample, window_size  # noqa: E402
from rtmap_models.data.samples import PriorNoise, Scene  # noqa: E402
from rtmap_models.export.example import example_inputs  # noqa: E402
from rtmap_models.export.onnx_file import export_onnx  # noqa: E402
from rtmap_models.paper.assign import Assigner, jobs_of, many_jobs  # noqa: E402
from rtmap_models.paper.attention import SelfAttention  # noqa: E402
from rtmap_models.paper.criterion import (  # noqa: E402
    focal_loss,
    image_target,
    laplace_nll,
    paper_losses,
    pose_loss,
)
from rtmap_models.paper.encoders import CameraEncoder  # noqa: E402
from rtmap_models.paper.lift import CameraLift  # noqa: E402
from rtmap_models.paper.pose import LearnedPose  # noqa: E402
from rtmap_models.paper.prediction import PaperPrediction  # noqa: E402
from rtmap_models.paper.resnet import ResNet, load_backbone  # noqa: E402
from rtmap_models.tiny.decoder import LayerOutput  # noqa: E402

from rtmap_cli.errors import BadInput  # noqa: E402
from rtmap_cli.steps.evaluate.maps.precision import Scorer  # noqa: E402

CAMERAS = 2


def small(**changes: Any) -> PaperConfig:
    """``rtmap-r18-small`` with every size cut down."""
    values = tomllib.loads((CONFIGS / "rtmap-r18-small.toml").read_text(encoding="utf-8"))
    values.pop("training", None)
    values |= {
        "name": "test", "image_size": [32, 64], "cell_m": 0.75, "supersample": 1,
        "vertex_count": 10, "backbone_width": 8, "image_width": 16, "width": 32, "heads": 2,
        "layers": 1, "new_queries": 10, "many_queries": 8, "many_repeat": 2, "feedforward": 32,
        "deform_points": 2, "raster_channels": 4,
    }  # fmt: skip
    config = config_from_dict(values | changes)
    assert isinstance(config, PaperConfig)
    return config


def painted_frames(config: PaperConfig, count: int = 8) -> list[Frame]:
    """Straight roads at other places and headings, drawn into pictures and camera images."""
    rng = np.random.default_rng(0)
    projections = example_inputs(config, 1, CAMERAS, 1)[1][0].numpy()
    rows, columns = window_size(config)
    frames = []
    for _ in range(count):
        y, angle = rng.uniform(-4, 4), rng.uniform(-0.15, 0.15)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        lines = [(2, [[-60, y - 6], [60, y - 6]]), (1, [[-60, y], [60, y]])]
        if rng.random() < 0.6:
            x = rng.uniform(-15, 15)
            lines.append((0, [[x, y - 6], [x + 4, y - 6], [x + 4, y], [x, y], [x, y - 6]]))
        images = np.full((CAMERAS, *config.image_size, 3), 60, np.uint8)
        picture = np.full((rows, columns, 4), 60, np.uint8)
        points = [np.array(p, dtype=np.float64) @ turn.T for _, p in lines]
        for (c, _), p in zip(lines, points, strict=True):
            dense = np.concatenate([np.linspace(a, b, 400) for a, b in pairwise(p)])
            colour = (220, 80 * c, 220 - 80 * c)
            cell = np.round(dense / config.cell_m + [columns / 2, rows / 2] - 0.5).astype(int)
            inside = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
            picture[cell[inside, 1], cell[inside, 0], :3] = colour
            for image, e in zip(images, projections, strict=True):
                u, v, depth = e[:, :2] @ dense.T + e[:, 3:]
                ahead = depth > 0.5
                pixel = np.round(np.stack([u, v])[:, ahead] / depth[ahead]).astype(int).T
                seen = ((pixel >= 0) & (pixel < config.image_size[::-1])).all(axis=1)
                image[pixel[seen, 1], pixel[seen, 0]] = colour
        offsets = np.cumsum([0] + [len(p) for p in points])
        scene = Scene(np.concatenate(points), offsets, np.array([c for c, _ in lines]))
        frames.append(Frame(picture, scene, images, projections.copy()))
    return frames


def batch_of(config: PaperConfig, priors: list[str], seed: int = 0) -> Batch:
    rng, noise = np.random.default_rng(seed), PriorNoise(1.0, 1.0, 0.3, 0.3, 0.0)
    frames = painted_frames(config, len(priors))
    return collate(
        [
            make_sample(f, config, rng, noise, prior=p, train=False)
            for f, p in zip(frames, priors, strict=True)
        ],
        config,
    )


def fit(network: Any, batch: Batch, steps: int, rate: float = 4e-3) -> list[float]:
    """Train on one batch; the loss after every step."""
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=0.01)
    history = []
    for step in range(steps):
        for group in optimizer.param_groups:
            warm = min(1.0, (step + 1) / 8)
            group["lr"] = rate * warm * 0.5 * (1 + math.cos(math.pi * step / steps))
        loss = torch.stack(list(network.losses(batch).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        history.append(float(loss.detach()))
    return history


@torch.no_grad()
def mean_ap(network: Any, batch: Batch) -> float:
    """mAP of the answers on the batch's own truth."""
    config = network.eval().config
    prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
    answer = network.answer(network.predict_batch(batch), *prior)
    scorer = Scorer(config.classes, protocol="rtmap")
    for b in range(len(prior[0])):
        best = answer.scores[b].argmax(dim=-1).tolist()
        found = [
            (config.classes[c], p, float(s[c]))
            for s, p, c in zip(
                answer.scores[b], answer.points[b].double().numpy(), best, strict=True
            )
            if s[c] > 0.02
        ]
        truth = [
            (config.classes[batch.truth_class[g]], batch.truth_orders[g, 0].double().numpy(), 1.0)
            for g in range(batch.truth_start[b], batch.truth_start[b + 1])
        ]
        scorer.add(found, truth)
    return float(scorer.result().mAP)


@pytest.fixture(scope="module")
def learnt() -> tuple[Any, Batch, list[float], float]:
    """A network that has learnt eight frames by heart; loss by step; mAP before."""
    torch.manual_seed(0)
    config = small(many_queries=0)
    network = build_network(config)
    batch = batch_of(config, ["none", "hidden", "seen", "none"] * 2)
    before = mean_ap(network, batch)
    return network, batch, fit(network, batch, 90), before


# --- configurations -------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rtmap-r50", "rtmap-r18-small"])
def test_shipped_configurations_describe_the_papers_network(name: str) -> None:
    config = load_config(name)
    assert isinstance(config, PaperConfig) and config.needs_images
    assert config.range_m == (-36.0, -18.0, 36.0, 18.0) and config.vertex_count == 20
    assert (config.nll_weight, config.manhattan_weight) == (0.03, 5.0)
    assert config.translation_weight == 0.04 and config.pose == "least_squares"
    assert config.pre_attribution and config.use_nll and config.use_pose_loss
    assert config_from_dict(config.to_dict()) == config


def test_r50_builds_at_full_size() -> None:
    config = load_config("rtmap-r50")
    with torch.device("meta"):
        network = build_network(config)
    assert len(network.decoder.layers) == 6 and network.encoder.backbone.widths[-1] == 2048


def test_a_configuration_without_architecture_is_tiny() -> None:
    config = load_config()
    values = config.to_dict()
    assert values.pop("architecture") == "tiny"
    assert config_from_dict(values) == config and not config.needs_images


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"architecture": "huge"}, "unknown architecture"),
        ({"backbone": "vgg"}, "backbone must be one of"),
        ({"heads": 5}, "multiple of heads"),
        ({"image_size": [33, 64]}, "multiples of 32"),
        ({"layers": 0}, "at least 1"),
        ({"layers": "two"}, "wrong type"),
        ({"use_nll": 1}, "wrong type"),
        ({"heights_m": [0.0, "a"]}, "wrong type"),
        ({"surprise": 1}, "unknown keys: surprise"),
        ({"range_m": [-36, -18, 30, 18]}, "centred"),
    ],
)
def test_bad_configurations(change: dict[str, Any], what: str) -> None:
    with pytest.raises(BadInput, match=what):
        small(**change)


# --- backbone -------------------------------------------------------------------------------


def test_resnet_is_named_and_sized_as_torchvisions() -> None:
    with torch.device("meta"):
        resnet = {kind: ResNet(kind) for kind in ("resnet18", "resnet50")}
    count = {k: sum(p.numel() for p in m.parameters()) for k, m in resnet.items()}
    assert count == {"resnet18": 11_176_512, "resnet50": 23_508_032}  # torchvision's, less fc
    names = set(resnet["resnet50"].state_dict())
    assert len(names) == 318
    assert {
        "conv1.weight",
        "bn1.running_var",
        "layer1.0.downsample.0.weight",
        "layer1.0.downsample.1.bias",
        "layer4.2.bn3.num_batches_tracked",
    } <= names
    shape = resnet["resnet50"].state_dict()["layer3.0.conv2.weight"].shape
    assert tuple(shape) == (256, 256, 3, 3)


def test_backbone_loads(tmp_path: Path) -> None:
    torch.manual_seed(1)
    donor = ResNet("resnet18", base=8)
    for p in donor.buffers():
        p.copy_(torch.rand(p.shape) + 0.5)
    state = {k: v for k, v in donor.state_dict().items() if "num_batches" not in k}
    state |= {"fc.weight": torch.zeros(1000, 64), "fc.bias": torch.zeros(1000)}
    torch.save({"state_dict": state}, tmp_path / "r18.pt")
    network = build_network(small(backbone_norm="frozen"))
    load_backbone(network, tmp_path / "r18.pt")
    network.train()
    x = torch.randn(2, 3, 32, 64)
    before = {k: v.clone() for k, v in network.encoder.backbone.state_dict().items()}
    expected = donor.eval()(x)
    for a, b in zip(network.encoder.backbone(x), expected, strict=True):
        assert torch.allclose(a, b, atol=1e-4)  # frozen: training mode changes nothing
    assert all(torch.equal(v, before[k]) for k, v in network.encoder.backbone.state_dict().items())


def _damage(path: Path, how: str) -> None:
    state: Any = ResNet("resnet18", base=8).state_dict()
    if how == "text":
        path.write_text("hello")
        return
    if how == "list":
        state = [1, 2]
    elif how == "missing tensor":
        del state["layer3.1.bn2.bias"]
    elif how == "shape":
        state["conv1.weight"] = torch.zeros(64, 3, 7, 7)
    elif how == "extra":
        state["layer9.weight"] = torch.zeros(1)
    elif how == "nan":
        state["conv1.weight"] = state["conv1.weight"] * float("nan")
    torch.save(state, path)


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("none", "no such file"),
        ("text", "not a state dict"),
        ("list", "not a state dict"),
        ("missing tensor", "no tensor layer3.1.bn2.bias"),
        ("shape", "not \\(8, 3, 7, 7\\)"),
        ("extra", "unknown tensor layer9.weight"),
        ("nan", "not finite"),
    ],
)
def test_bad_backbones(how: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    if how != "none":
        _damage(path, how)
    with pytest.raises(BadInput, match=what):
        load_backbone(build_network(small()), path)


def test_a_raster_network_takes_no_backbone(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no ResNet"):
        load_backbone(build_network(small(encoder="raster")), tmp_path / "any.pt")


# --- lift -----------------------------------------------------------------------------------


def test_lift_reads_where_calibration_says() -> None:
    """Features that hold their own pixel come back with the projection of the cell."""
    config = small(image_size=[64, 128], heights_m=[0.0], heads=1, width=4, image_width=4)
    lift = CameraLift(config)
    projections = example_inputs(config, 1, 5, 1)[1]
    stride, (h, w) = config.image_stride, (8, 16)
    v, u = torch.meshgrid(torch.arange(h) * stride, torch.arange(w) * stride, indexing="ij")
    camera = torch.arange(5.0)[:, None, None].expand(-1, h, w)
    own = torch.stack([u.float().expand(5, -1, -1), v.float().expand(5, -1, -1), camera], dim=1)
    samples = lift._choose(projections, h, w)
    read = read_maps(own[None], samples.camera, samples.column, samples.row)[0]
    pu, pv, _ = (x[0] for x in project(lift.points, projections))
    rows, columns = config.bev_size
    seen = samples.seen[0, 0] > 0
    assert 0.5 < float(seen.float().mean()) <= 1.0
    best = samples.camera[0, 0]
    wanted_u, wanted_v = (x.gather(0, best[None])[0] for x in (pu, pv))
    inner = seen & (wanted_v < (h - 1) * stride) & (wanted_u < (w - 1) * stride)
    inner &= (wanted_u > 0) & (wanted_v > 0)
    assert int(inner.sum()) > 100 and len(best) == rows * columns
    assert torch.allclose(read[0, 0][inner], wanted_u[inner], atol=0.05)
    assert torch.allclose(read[1, 0][inner], wanted_v[inner], atol=0.05)
    assert torch.allclose(read[2, 0][inner], best[inner].float(), atol=1e-3)


def test_padded_cameras_change_nothing(learnt: Any) -> None:
    network = learnt[0].eval()
    images, projections, *prior = example_inputs(network.config, 2, 3, 4)
    more = torch.cat([images, torch.full_like(images[:, :2], 200)], dim=1)
    padded = torch.cat([projections, torch.zeros_like(projections[:, :2])], dim=1)
    with torch.no_grad():
        plain, wide = network(images, projections, *prior), network(more, padded, *prior)
    for a, b in zip(plain, wide, strict=True):
        assert torch.allclose(a, b, atol=1e-3, rtol=1e-3)


def test_absent_cameras_do_not_reach_the_statistics() -> None:
    torch.manual_seed(0)
    config = small()
    encoder = CameraEncoder(config).train()
    batch = batch_of(config, ["none", "none"])
    twin = CameraEncoder(config).train()
    twin.load_state_dict(encoder.state_dict())
    encoder.encode(batch)
    batch.images = torch.cat([batch.images, torch.full_like(batch.images[:, :1], 255)], dim=1)
    absent = torch.zeros_like(batch.ego_to_image[:, :1])
    batch.ego_to_image = torch.cat([batch.ego_to_image, absent], dim=1)
    twin.encode(batch)
    for (name, a), b in zip(encoder.named_buffers(), twin.buffers(), strict=True):
        assert torch.allclose(a.float(), b.float(), atol=1e-4), name


# --- decoder, prior, pose -------------------------------------------------------------------


def test_an_empty_prior_and_unused_slots_change_nothing(learnt: Any) -> None:
    network = learnt[0].eval()
    n = network.config.new_queries
    images, projections, points, class_id, _ = example_inputs(network.config, 2, 3, 4)
    one = (torch.zeros_like(points[:, :1]), class_id[:, :1] * 0, torch.zeros(2, 1))
    unused = (points, class_id, torch.zeros(2, 4))
    with torch.no_grad():
        empty, full = network(images, projections, *one), network(images, projections, *unused)
    assert torch.allclose(empty.points[:, :n], full.points[:, :n], atol=1e-4)
    assert torch.equal(full.prior_score, torch.zeros(2, 4))
    assert torch.equal(full.pose_delta, torch.zeros(2, 3))
    assert bool(torch.isfinite(full.pose_covariance).all())


def test_slots_may_come_in_any_order(learnt: Any) -> None:
    network = learnt[0].eval()
    n = network.config.new_queries
    images, projections, points, class_id, mask = example_inputs(network.config, 1, 3, 6)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    with torch.no_grad():
        a = network(images, projections, points, class_id, mask)
        b = network(images, projections, points[:, order], class_id[:, order], mask[:, order])
    assert torch.allclose(a.points[:, n:][:, order], b.points[:, n:], atol=1e-3)
    assert torch.allclose(a.prior_score[:, order], b.prior_score, atol=1e-4)


def test_a_hidden_prior_does_not_reach_the_new_queries(learnt: Any) -> None:
    network, batch, *_ = learnt
    network.eval()
    n = network.config.new_queries
    prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
    with torch.no_grad():
        encoded = network.encoder.encode(batch)
        empty = network.decode(encoded, prior[0], prior[1], torch.zeros_like(prior[2]))
        hidden = network.decode(encoded, *prior, torch.zeros(len(prior[0])))
        seen = network.decode(encoded, *prior)
    last = [x.layers[-1].points[:, :n] for x in (empty, hidden, seen)]
    assert torch.allclose(last[0], last[1], atol=1e-3)
    assert not torch.allclose(last[0], last[2], atol=1e-3)


def test_attention_in_bfloat16_is_attention() -> None:
    torch.manual_seed(0)
    attention = SelfAttention(16, 2, 0.0)
    x, place, weight = torch.randn(3, 2, 6, 16)
    bias = torch.zeros(2, 1, 6, 6)
    bias[..., 5] = -1e4  # the last token is not looked at
    results = []
    for bf16 in (False, True):
        attention.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            out = attention(x, place, bias)
        (out * weight).sum().backward()
        results.append((out.detach(), attention.query_key.weight.grad))
    for single, half in zip(*results, strict=True):
        assert torch.allclose(single, half, atol=0.05 * float(single.abs().max()))
    changed = x.clone()
    changed[:, 5] += 1.0
    with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
        assert torch.equal(attention(x, place, bias)[:, :5], attention(changed, place, bias)[:, :5])


def test_learned_pose_ignores_unused_slots() -> None:
    torch.manual_seed(0)
    head = LearnedPose(small())
    prior, tokens = torch.randn(2, 3, 10, 32), torch.randn(2, 3, 10, 32)
    mask = torch.tensor([[1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    delta = head(prior, tokens, mask)
    tokens[0, 1] += 100.0
    assert torch.equal(head(prior, tokens, mask), delta)
    assert torch.equal(delta[1], torch.zeros(3)) and bool((delta[0] != 0).any())


def test_pose_of_the_graph_is_a_choice(learnt: Any) -> None:
    network = learnt[0].eval()
    other = build_network(small(pose="learned", many_queries=0))
    other.load_state_dict(network.state_dict())
    inputs = example_inputs(network.config, 2, 3, 4)
    with torch.no_grad():
        squares, learned = network(*inputs), other.eval()(*inputs)
    assert torch.equal(squares.pose_covariance, learned.pose_covariance)
    assert not torch.allclose(squares.pose_delta, learned.pose_delta, atol=1e-3)


# --- matching and losses --------------------------------------------------------------------


def _truth_output(batch: Batch, queries: int, slots: int) -> LayerOutput:
    """New query k of a sample lies on its element k (backwards); nothing is said of classes."""
    batch_size, v = len(batch.prior_mask), batch.truth_orders.shape[2]
    points = torch.full((batch_size, queries + slots, v, 2), 30.0)
    for b in range(batch_size):
        for k, g in enumerate(range(batch.truth_start[b], batch.truth_start[b + 1])):
            points[b, k] = batch.truth_orders[g, 1]
    logits = torch.zeros(batch_size, queries + slots, 4)
    return LayerOutput(points, torch.zeros_like(points), logits)


def test_existence_aware_matching() -> None:
    config = small()
    batch = batch_of(config, ["none", "seen", "hidden", "seen"], seed=3)
    n, slots = config.new_queries, batch.prior_mask.shape[1]
    output = _truth_output(batch, n, slots)
    match = Assigner(batch, config)(output, jobs_of(batch, n, True))
    # New queries answer for what the prior lacks, never slots, and each for its own element.
    assert sorted(match.truth) == np.flatnonzero(batch.truth_new).tolist()
    assert (match.query < n).all() and not batch.truth_new.all()
    own = match.query + np.asarray(batch.truth_start)[match.sample]
    assert (own == match.truth).all()
    # Without pre-attribution all are asked for, a hidden prior apart from the new queries.
    match = Assigner(batch, config)(output, jobs_of(batch, n, False))
    counts = np.diff(batch.truth_start)
    slots_of = batch.prior_mask.sum(dim=1).long().tolist()
    wanted = [counts[0], counts[1], counts[2] + min(counts[2], slots_of[2]), counts[3]]
    assert np.bincount(match.sample, minlength=4).tolist() == wanted
    # One-to-many: every element `repeat` times, no query twice.
    many = Assigner(batch, config)(output, many_jobs(batch, config.many_queries), 2)
    assert np.bincount(many.truth).tolist() == [2] * len(batch.truth_class)
    assert len(set(zip(many.sample, many.query, strict=True))) == len(many.query)


def _perfect(batch: Batch, config: PaperConfig) -> PaperPrediction:
    """Everything right, and sure of it."""
    n = config.new_queries
    output = _truth_output(batch, n, batch.prior_mask.shape[1])
    points, logits = output.points, torch.full_like(output.logits, -12.0)
    points[:, n:] = batch.prior_target
    for b in range(len(points)):
        first = batch.truth_start[b]
        for g in range(first, batch.truth_start[b + 1]):
            if batch.truth_new[g]:
                logits[b, g - first, batch.truth_class[g]] = 12.0
        for p in torch.nonzero(batch.prior_real[b]).flatten().tolist():
            logits[b, n + p, batch.prior_class[b, p]] = 12.0
    layer = LayerOutput(points, torch.full_like(points, -3.0), logits)
    return PaperPrediction([layer], n, [batch.delta], [], None, None)


def test_a_perfect_answer_costs_nothing() -> None:
    config = small(many_queries=0, use_nll=False)
    batch = batch_of(config, ["none", "seen", "hidden", "seen"], seed=3)
    assert bool((batch.prior_mask > batch.prior_real).any())  # false elements, without a target
    prediction = _perfect(batch, config)
    parts = paper_losses(prediction, batch, config)
    assert set(parts) == {"class", "points", "direction", "pose"}
    for name, value in parts.items():
        assert float(value) == pytest.approx(0.0, abs=1e-3), name
    moved = prediction.layers[0]._replace(points=prediction.layers[0].points + 0.36)
    worse = paper_losses(prediction._replace(layers=[moved]), batch, config)
    # Eq. 3: 5 · V · (0.36 / 72 + 0.36 / 36), the mean over elements.
    assert float(worse["points"]) == pytest.approx(5.0 * 10 * 0.015, rel=1e-3)


def test_a_false_element_that_is_believed_costs() -> None:
    config = small(many_queries=0)
    batch = batch_of(config, ["none", "seen", "hidden", "seen"], seed=3)
    prediction = _perfect(batch, config)
    before = paper_losses(prediction, batch, config)["class"]
    b, p = torch.nonzero(batch.prior_mask * (1 - batch.prior_real))[0].tolist()
    prediction.layers[0].logits[b, config.new_queries + p, batch.prior_class[b, p]] = 6.0
    assert float(paper_losses(prediction, batch, config)["class"] - before) > 0.1


@pytest.mark.parametrize(
    ("change", "gone"),
    [
        ({"use_nll": False, "use_pose_loss": False, "many_queries": 0}, "laplace pose many"),
        ({"nll_weight": 0.0, "pose_weight": 0.0, "many_weight": 0.0}, "laplace pose many"),
        ({"direction_weight": 0.0, "bev_segmentation_weight": 0.0}, "direction segmentation"),
        ({"image_segmentation_weight": 0.0, "pre_attribution": False}, "image_segmentation"),
    ],
)
def test_every_part_of_the_loss_can_be_switched_off(change: dict[str, Any], gone: str) -> None:
    full = {"class", "points", "laplace", "direction", "pose", "many", "segmentation"}
    full |= {"image_segmentation"}
    network = build_network(small(**change)).train()
    assert set(network.losses(batch_of(small(), ["none", "seen"]))) == full - set(gone.split())


def test_formulas_of_the_losses() -> None:
    error, log_b = torch.tensor([0.3]), torch.tensor([math.log(0.2)])
    density = torch.distributions.Laplace(0.0, 0.2).log_prob(error)
    assert torch.allclose(laplace_nll(error, log_b), -density)
    # p = 0.5: positives 0.25 · 0.25 · ln 2, negatives 0.75 · 0.25 · ln 2.
    values = focal_loss(torch.zeros(2), torch.tensor([1.0, 0.0]))
    assert torch.allclose(values, torch.tensor([0.0625, 0.1875]) * math.log(2.0))
    config = small()
    batch = batch_of(config, ["seen", "none"])
    off = batch.delta + torch.tensor([[1.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    assert float(pose_loss(off, batch, config)) == pytest.approx(0.04 * (1.0 - 0.005), rel=1e-4)


def test_image_target_lies_on_the_painted_lines() -> None:
    config = small(image_size=[64, 128])
    batch = batch_of(config, ["none"] * 2)
    stride = config.image_stride
    like = torch.zeros(2, CAMERAS, 3, 64 // stride, 128 // stride)
    target = image_target(batch, like, config)
    assert 0.02 < float(target.mean()) < 0.4
    painted = (batch.images.float() - 60).abs().amax(dim=-1) > 0
    pad = torch.nn.functional.max_pool2d(painted.float(), 2 * stride + 1, 1, stride)
    near = pad[:, :, ::stride, ::stride]
    assert bool((near[target.amax(dim=2) > 0] > 0).all())


# --- the whole ------------------------------------------------------------------------------


@pytest.mark.parametrize("encoder", ["camera", "raster"])
def test_gradients_reach_every_parameter(encoder: str) -> None:
    torch.manual_seed(0)
    config = small(encoder=encoder, layers=2)
    network = build_network(config).train()
    parts = network.losses(batch_of(config, ["none", "hidden", "seen", "seen"]), bf16=True)
    torch.stack(list(parts.values())).sum().backward()
    dead = [k for k, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert dead == []
    assert all(bool(torch.isfinite(p.grad).all()) for p in network.parameters())


def test_eight_frames_are_learnt_by_heart(learnt: Any) -> None:
    network, batch, history, before = learnt
    assert np.mean(history[-3:]) < 0.2 * history[0]
    assert before < 0.05 and mean_ap(network, batch) > 0.5
    with torch.no_grad():
        last = network.predict_batch(batch).layers[-1]
    n = network.config.new_queries
    exists, used = last.logits[:, n:, 3], batch.prior_mask > 0
    real, false = (exists[used & (batch.prior_real == k)] for k in (1, 0))
    assert len(real) > 2 and len(false) > 2 and float(real.mean() - false.mean()) > 0.2


def test_export_equals_torch_at_two_sizes(learnt: Any, tmp_path: Path) -> None:
    import onnx

    network = learnt[0].eval()
    path = tmp_path / "paper.onnx"
    report = export_onnx(network, path, {})
    assert {row.size for row in report.rows} >= {(1, 7, 9), (3, 5, 1)}
    assert max(max(row.differences.values()) for row in report.rows) < 1e-3
    assert {node.domain for node in onnx.load(path).graph.node} == {""}


def test_a_raster_takes_the_cameras_place() -> None:
    torch.manual_seed(0)
    config = small(encoder="raster")
    assert not config.needs_images
    network = build_network(config)
    batch = batch_of(config, ["none", "hidden"])
    history = fit(network, batch, 25)
    assert history[-1] < 0.7 * history[0]
    prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
    with torch.no_grad():
        answer = network.eval()(batch.picture / 255.0, *prior)
        other = network(1.0 - batch.picture / 255.0, *prior)
    assert answer.points.shape == (2, config.new_queries + prior[2].shape[1], 10, 2)
    assert not torch.allclose(answer.points, other.points, atol=0.1)


def test_frames_without_images_are_refused() -> None:
    config = small()
    batch = batch_of(config, ["none"])
    batch.images = None
    with pytest.raises(BadInput, match="no camera images"):
        build_network(config).losses(batch)
