"""The network's mathematics: the warp, the pose, the orders of vertices, the wrong prior."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
cv2 = pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

from rtmap_models.answer import laplace_sigma  # noqa: E402
from rtmap_models.bev import BevWarp, camera_centres, cell_centres  # noqa: E402
from rtmap_models.config import load_config  # noqa: E402
from rtmap_models.data.samples import (  # noqa: E402
    FIELD_REACH_M,
    PriorNoise,
    Scene,
    clip,
    equivalent_orders,
    field_target,
    heat_target,
    make_prior,
    rotation,
    segmentation_target,
)
from rtmap_models.pose import PoseHead, inverse3, solve3  # noqa: E402

from rtmap_cli.geometry.cameras import projection  # noqa: E402


def looking_forward(height: float = 1.5) -> np.ndarray:
    """ego_SE3_camera of a level camera that looks along +x."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    pose[2, 3] = height
    return pose


def scene_of(*elements: tuple[int, list]) -> Scene:
    points = [np.array(p, dtype=float) for _, p in elements]
    offsets = np.cumsum([0] + [len(p) for p in points])
    return Scene(np.concatenate(points), offsets, np.array([c for c, _ in elements]))


ROAD = scene_of(
    (2, [[-50, 5], [50, 5]]),
    (2, [[-50, -5], [50, -5]]),
    (1, [[-50, 0], [50, 0]]),
    (0, [[10, -5], [14, -5], [14, 5], [10, 5], [10, -5]]),
)


def test_camera_centre_from_the_projection() -> None:
    k = np.array([[100.0, 0, 50], [0, 100, 30], [0, 0, 1]])
    pose = looking_forward(1.7)
    pose[:2, 3] = [0.4, -0.2]
    e = torch.tensor(projection(k, pose), dtype=torch.float32)[None, None]
    assert torch.allclose(camera_centres(e)[0, 0], torch.tensor([0.4, -0.2, 1.7]), atol=1e-4)
    assert torch.equal(camera_centres(torch.zeros(1, 1, 3, 4)), torch.zeros(1, 1, 3))


def test_warp_finds_the_colour_of_the_ground() -> None:
    """A picture painted by ground position comes back at that position."""
    k = np.array([[110.0, 0, 111.5], [0, 110, 38.0], [0, 0, 1]])
    e = projection(k, looking_forward())
    v, u = np.mgrid[0:128, 0:224]
    depth = 110.0 * 1.5 / np.maximum(v - 38.0, 1e-3)  # the ground that a pixel below sees
    image = np.zeros((128, 224, 3), np.uint8)
    image[..., 0] = np.clip(depth * 8, 0, 255)
    image[..., 1] = np.clip(128 - (u - 111.5) / 110.0 * depth * 8, 0, 255)
    warp = BevWarp(36.0, 18.0, 144, 288, 1)
    out = warp(torch.from_numpy(image)[None, None], torch.tensor(e[None, None]).float())[0].numpy()
    centres = cell_centres(36.0, 18.0, 144, 288).numpy()
    seen = out[3] > 0
    assert not seen[:, :144].any()  # nothing is seen behind
    close = seen & (centres[..., 0] < 12) & (np.abs(centres[..., 1]) < 6)
    assert close.sum() > 500
    assert np.abs(out[0] - centres[..., 0] * 8)[close].max() < 6
    assert np.abs(out[1] - 128 - centres[..., 1] * 8)[close].max() < 6
    blocks = cell_centres(36.0, 18.0, 72, 144).numpy().repeat(2, axis=0).repeat(2, axis=1)
    expected = np.sqrt(1.5 / np.sqrt((blocks**2).sum(-1) + 1.5**2)) * 255
    assert np.abs(out[3] - expected)[close].max() < 0.5


def test_warp_of_odd_sizes_is_cut_from_whole_blocks() -> None:
    rng = np.random.default_rng(0)
    e = projection(np.array([[110.0, 0, 111.5], [0, 110, 38.0], [0, 0, 1]]), looking_forward())
    image = torch.from_numpy(rng.integers(0, 256, (1, 1, 128, 224, 3), dtype=np.uint8))
    e = torch.tensor(e[None, None]).float()
    odd = BevWarp(31 / 2, 15 / 2, 15, 31, 2)(image, e)
    assert odd.shape == (1, 4, 15, 31)
    # Cells of 1 m whose rows and columns are counted from the same corner.
    even = BevWarp(32 / 2, 16 / 2, 16, 32, 2)
    even.centres += 0.5
    even.ground += 0.5
    assert torch.allclose(even(image, e)[:, :, :15, :31], odd, atol=1e-2)


def test_an_absent_camera_shows_nothing() -> None:
    warp = BevWarp(36.0, 18.0, 16, 32, 2)
    out = warp(torch.full((1, 2, 8, 8, 3), 200, dtype=torch.uint8), torch.zeros(1, 2, 3, 4))
    assert torch.equal(out, torch.zeros(1, 4, 16, 32))


def test_solve3_is_the_inverse() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(5, 3, 3))
    spd = torch.tensor(a @ a.transpose(0, 2, 1) + 0.1 * np.eye(3))
    b = torch.tensor(rng.normal(size=(5, 3)))
    assert torch.allclose(solve3(spd, b), torch.linalg.solve(spd, b))
    assert torch.allclose(inverse3(spd), torch.linalg.inv(spd))


@pytest.mark.parametrize("seed", range(5))
def test_pose_head_finds_the_correction_despite_outliers(seed: int) -> None:
    config, rng = load_config(), np.random.default_rng(seed)
    noise = PriorNoise(sigma_m=1.0, sigma_deg=1.0, drop=0.0, fake=0.0, margin_m=0.0)
    prior = make_prior(ROAD, clip(ROAD, config), config, noise, rng)
    refined = prior.target.copy()
    refined[0, :5] += 3.0
    p, q = (torch.tensor(x, dtype=torch.float32)[None] for x in (prior.points, refined))
    weight = torch.ones(p.shape[:2])
    estimate = PoseHead()(p, q, torch.full_like(p, 0.1), weight)
    error = estimate.delta[0].numpy() - prior.delta
    assert np.abs(error).max() < 0.05
    covariance = estimate.covariance[0].numpy()
    assert np.allclose(covariance, covariance.T, rtol=1e-3)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_pose_head_says_what_it_cannot_know() -> None:
    """Two lines along x, places along them unknown to 5 m: sideways is known, forward is not."""
    x = torch.linspace(-30, 30, 20)
    lines = torch.stack([torch.stack([x, torch.full_like(x, y)], -1) for y in (-4.0, 4.0)])[None]
    scale = torch.tensor([5.0, 0.1]).expand_as(lines)
    estimate = PoseHead()(lines, lines, scale, torch.ones(1, 2))
    sigma = estimate.covariance[0].diagonal().sqrt()
    assert sigma[0] > 1.0 and sigma[1] < 0.1
    nothing = PoseHead()(lines, lines + 1, scale, torch.zeros(1, 2))
    assert torch.equal(nothing.delta, torch.zeros(1, 3))
    assert torch.allclose(nothing.covariance[0].diagonal().sqrt(), PoseHead().prior_sigma)


def test_laplace_scale_becomes_a_standard_deviation() -> None:
    draws = np.random.default_rng(0).laplace(0.0, 0.3, 200_000)
    assert float(laplace_sigma(torch.tensor(0.3))) == pytest.approx(draws.std(), rel=0.01)


def test_orders_of_rings_and_lines() -> None:
    config = load_config()
    truth = clip(ROAD, config)
    assert sorted(truth.classes.tolist()) == [0, 1, 2, 2]
    ring = truth.points[truth.closed][0]
    assert np.allclose(ring[0], ring[-1])
    orders = equivalent_orders(ring, True)
    assert orders.shape == (19, 20, 2)
    assert np.allclose(orders[:, 0], orders[:, -1])
    assert len({tuple(np.round(o[0], 6)) for o in orders}) == 19
    line = truth.points[~truth.closed][0]
    orders = equivalent_orders(line, False)
    assert np.array_equal(orders[0], line) and np.array_equal(orders[1], line[::-1])


def test_prior_is_the_scene_at_the_wrong_pose() -> None:
    config = load_config()
    truth = clip(ROAD, config)
    noise = PriorNoise(sigma_m=1.0, sigma_deg=2.0, drop=0.0, fake=0.0, margin_m=0.0)
    prior = make_prior(ROAD, truth, config, noise, np.random.default_rng(3))
    assert prior.real.all() and len(prior.kept) == 4
    again = prior.target @ rotation(prior.delta[2]).T + prior.delta[:2]
    assert np.allclose(again, prior.points)
    assert (np.abs(prior.points) <= np.array(config.half_range) + 1e-6).all()
    # Vertices of lines stay on their lines: the target differs from the truth only along them.
    for p, c in zip(prior.target, prior.classes, strict=True):
        if c == 1:
            assert np.abs(p[:, 1]).max() < 1e-9


def test_false_elements_lie_apart_from_true_ones() -> None:
    config = load_config()
    truth = clip(ROAD, config)
    noise = PriorNoise(drop=0.3, fake=0.6)
    made = [
        make_prior(ROAD, truth, config, noise, np.random.default_rng(seed)) for seed in range(20)
    ]
    assert sum((~p.real).sum() for p in made) > 10
    assert sum(len(p.kept) for p in made) < 20 * 4 * 0.9
    for p in made:
        for line, c in zip(p.target[~p.real], p.classes[~p.real], strict=True):
            same = truth.points[truth.classes == c].reshape(-1, 2)
            gap = np.linalg.norm(line[:, None] - same[None], axis=-1).min(axis=1).mean()
            assert gap > 1.0


def test_dense_targets() -> None:
    config = load_config()
    truth = clip(ROAD, config)
    heat, cells = heat_target(truth, config)
    assert heat.shape == (3, 36, 72) and heat.max() == 1.0
    assert set(cells[:, 3]) == {0, 1, 2, 3}
    segmentation = segmentation_target(truth, config)
    assert segmentation.shape == (3, 72, 144)
    assert segmentation[0, 36, 72 + 24] == 1 and segmentation[0, 36, 72] == 0


def test_field_points_to_the_nearest_element() -> None:
    config = load_config()
    field = field_target(clip(ROAD, config), config)
    rows, columns = (size // 2 for size in config.picture_size)
    assert field.shape == (3, 2, rows, columns)
    centres = cell_centres(*config.half_range, rows, columns).numpy()
    x, y = centres[..., 0], centres[..., 1]
    divider, near = field[1], np.abs(y) < FIELD_REACH_M - 0.2
    assert np.abs(divider[1] + y)[near].max() < 0.05 and np.abs(divider[0])[near].max() < 0.36
    assert np.isnan(divider[:, np.abs(y) > FIELD_REACH_M + 0.2]).all()
    # The long sides x = 10 and 14 are nearest; half a cell from the middle either may be.
    inside = (x > 11) & (x < 13) & (np.abs(x - 12) > 0.5) & (np.abs(y) < 2)
    away = np.abs(x + field[0, 0] - np.where(x < 12, 10, 14))[inside]
    assert away.max() < 0.05
    crossing_only = scene_of((0, [[10, -5], [14, -5], [14, 5], [10, 5], [10, -5]]))
    assert np.isnan(field_target(clip(crossing_only, config), config)[1:]).all()
