"""The models of odometry and GNSS on a real drive: wheels, gyro and receiver of comma2k19.

A kilometre of highway (60 s). The reference is the data set's own trajectory; it is smooth, and
better than a metre as a whole, which is what the comparison needs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rtmap_cli.geometry.poses import se3_from_xyyaw, wrap_angle
from rtmap_cli.logs.run import RunFrames
from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import STATE, Motion, motion_of, motion_terms, step_error
from rtmap_cli.steps.localize.model import ErrorModel, Settings

MODEL, SETTINGS = ErrorModel(), Settings()
CRS = 32610
EVERY = 10
"""Two frames a second of the twenty that the reference has."""
GNSS_SIGMA = np.array([1.5, 1.5, np.radians(1.5)])


@dataclass(frozen=True)
class RealDrive:
    """``truth``, ``gnss`` (T, 3) x, y, yaw; ``odometry`` (T, 3) from wheels and gyro."""

    truth: np.ndarray
    gnss: np.ndarray
    odometry: np.ndarray
    time_ns: np.ndarray

    @property
    def travelled(self) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.truth[:, :2], axis=0).T))])


def _forward(quaternion: np.ndarray) -> np.ndarray:
    """(T, 3) ECEF direction in which the camera looks: its x axis."""
    w, x, y, z = quaternion.T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)


@pytest.fixture(scope="module")
def real(rtmap_data: Path) -> RealDrive:
    from pyproj import Transformer

    folder = rtmap_data / "comma2k19" / "example_1"
    if not folder.is_dir():
        pytest.skip("sample data has no comma2k19/example_1")

    def load(name: str) -> np.ndarray:
        return np.load(folder / name, allow_pickle=False)

    time = load("global_pose/frame_times")
    position, look = (load(f"global_pose/frame_{n}") for n in ("positions", "orientations"))
    ecef = Transformer.from_crs(4978, CRS, always_xy=True)
    x, y, _ = ecef.transform(*position.T)
    ahead = ecef.transform(*(position + _forward(look)).T)
    yaw = np.unwrap(np.arctan2(ahead[1] - y, ahead[0] - x))
    # The camera looks a degree aside of where the car drives.
    course = np.arctan2(np.gradient(y, time), np.gradient(x, time))
    yaw -= np.median(wrap_angle(yaw - course))
    ublox, at = (load(f"processed_log/GNSS/live_gnss_ublox/{n}") for n in ("value", "t"))
    east, north = Transformer.from_crs(4326, CRS, always_xy=True).transform(
        ublox[:, 1], ublox[:, 0]
    )
    wheels, rolled = (load(f"processed_log/CAN/wheel_speed/{n}") for n in ("value", "t"))
    gyro, turned = (load(f"processed_log/IMU/gyro/{n}") for n in ("value", "t"))
    frames = np.arange(EVERY, len(time) - EVERY, EVERY)
    t = time[frames]
    bearing = np.interp(t, at, np.unwrap(np.radians(ublox[:, 5])))
    gnss = np.column_stack([np.interp(t, at, east), np.interp(t, at, north), np.pi / 2 - bearing])
    distance = np.concatenate([[0.0], np.cumsum(wheels[1:].mean(axis=1) * np.diff(rolled))])
    heading = np.concatenate([[0.0], np.cumsum(-gyro[1:, 2] * np.diff(turned))])
    odometry = np.full((len(t), 3), np.nan)
    steps = np.diff(np.interp(t, rolled, distance)), np.diff(np.interp(t, turned, heading))
    # A car has no motion to the side: half of its turn bends the step.
    odometry[1:] = np.column_stack([steps[0], 0.5 * steps[0] * steps[1], steps[1]])
    truth = np.column_stack([x, y, yaw])[frames]
    zero = np.array([*truth[0, :2], 0.0])
    return RealDrive(truth - zero, gnss - zero, odometry, np.round(t * 1e9).astype(np.int64))


def _frames(drive: RealDrive) -> RunFrames:
    n = len(drive.truth)
    return RunFrames(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=drive.time_ns,
        initial=se3_from_xyyaw(*drive.gnss.T),
        sigma=np.tile(GNSS_SIGMA, (n, 1)),
        odometry=drive.odometry,
        odometry_sigma=np.full((n, 3), np.nan),
        end_to_end=np.full((n, 3), np.nan),
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.zeros(n, np.int32),
    )


def _calibrated(drive: RealDrive) -> RealDrive:
    """Wheels as large as GNSS says: their radius is 0.7 % off, in every step alike, and the model
    of odometry knows errors of single steps only."""
    rolled = np.nansum(drive.odometry[:, 0])
    size = np.hypot(*np.diff(drive.gnss[:, :2], axis=0).T).sum() / rolled
    assert 1.0 < size < 1.02
    return replace(drive, odometry=drive.odometry * [size, size, 1.0])


def _smoothed(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 3) and covariances (T, 3, 3) from odometry and GNSS alone."""
    pose, bias = motion.gnss.copy(), np.zeros_like(motion.gnss)
    for _ in range(5):
        step = motion_terms(motion, pose, bias).solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
    system = BlockSystem([STATE * len(pose)])
    terms = motion_terms(motion, pose, bias)
    system.add_chain(STATE * np.arange(len(pose)), terms.own, terms.below, terms.gradient)
    system.factor()
    blocks = system.marginals()[0].reshape(len(pose), STATE, len(pose), STATE)
    rows = np.arange(len(pose))
    return pose, blocks[rows, :3, rows, :3]


def test_odometry_errors_are_as_assumed(real: RealDrive) -> None:
    """1 % of a step and 0.05° per metre, which a run without sigmas of its own gets."""
    motion = motion_of(_frames(real), real.gnss, MODEL, SETTINGS)
    error, _ = step_error(real.truth[:-1], real.truth[1:], real.odometry[1:])
    size = np.abs(error) / motion.odometry_sigma[1:]
    inside = (size < 1.645).mean(axis=0)
    assert np.nanmax(np.abs(real.odometry[1:, 0] - motion.step[1:])) < 1e-3
    assert inside[0] > 0.85 and inside[2] > 0.85, inside
    assert np.abs(error[:, 0]).mean() < 0.01 * motion.step[1:].mean()
    # Nothing is assumed that is far too cautious either.
    assert np.sqrt((size[:, 0] ** 2).mean()) > 0.3


def test_the_error_of_gnss_walks_as_modelled(real: RealDrive) -> None:
    """Its error changes by no more than gnss_walk_m √distance, and it does change."""
    error = (real.gnss - real.truth)[:, :2]
    s = real.travelled
    for distance in (50.0, 100.0, 200.0):
        later = np.searchsorted(s, s + distance)
        known = later < len(s)
        change = error[later[known]] - error[known]
        rms = np.sqrt((change**2).mean())
        model = MODEL.gnss_walk_m * np.sqrt(distance)
        assert 0.1 * model < rms < 1.3 * model, (distance, rms, model)
    assert np.abs(error.mean(axis=0)).max() > 3 * np.diff(error, axis=0).std() / np.sqrt(len(s))


def test_white_noise_is_told_from_bias(real: RealDrive) -> None:
    """The receiver is smooth: of 1.5 m that it states, hardly any is white."""
    motion = motion_of(_frames(real), real.gnss, MODEL, SETTINGS)
    assert motion.white[:, :2].max() < 0.3
    assert np.hypot(motion.white, motion.slow) == pytest.approx(
        np.tile(GNSS_SIGMA, (len(real.truth), 1))
    )
    rng = np.random.default_rng(0)
    rough = real.gnss + rng.normal(size=real.gnss.shape) * [0.8, 0.8, 0.01]
    noisy = motion_of(_frames(replace(real, gnss=rough)), rough, MODEL, SETTINGS)
    assert noisy.white[:, :2].mean() == pytest.approx(0.8, rel=0.3)


def test_smoothing_without_a_map_follows_the_road(real: RealDrive) -> None:
    """What white noise adds to GNSS goes; what its bias has stays, and is stated."""
    real = _calibrated(real)
    rng = np.random.default_rng(1)
    rough = real.gnss + rng.normal(size=real.gnss.shape) * [0.8, 0.8, 0.01]
    motion = motion_of(_frames(replace(real, gnss=rough)), rough, MODEL, SETTINGS)
    pose, covariance = _smoothed(motion)
    off = pose - real.truth
    off[:, 2] = wrap_angle(off[:, 2])
    before = rough - real.truth
    assert off[:, :2].std(axis=0).max() < 0.5 * before[:, :2].std(axis=0).min()
    square = np.einsum("ti,tij,tj->t", off, np.linalg.inv(covariance), off)
    assert (square < 6.25).mean() > 0.85
    sigma = np.sqrt(covariance[:, [0, 1], [0, 1]])
    assert 0.5 < sigma.mean() < 1.5


def test_a_gap_in_the_odometry_is_bridged_by_gnss(real: RealDrive) -> None:
    odometry = real.odometry.copy()
    odometry[50:54] = np.nan
    gap = replace(real, odometry=odometry)
    motion = motion_of(_frames(gap), gap.gnss, MODEL, SETTINGS)
    pose, covariance = _smoothed(motion)
    whole, sure = _smoothed(motion_of(_frames(real), real.gnss, MODEL, SETTINGS))
    assert np.abs(pose - whole)[:, :2].max() < 1.0
    assert covariance[52, 2, 2] > sure[52, 2, 2]
