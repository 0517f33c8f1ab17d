"""Centre lines of a density field: sub-cell ridge points, linked into polylines.

Ridge points after Steger, "An unbiased detector of curvilinear structures" (1998): along the
direction of the strongest negative second derivative the first derivative vanishes inside the
cell. Points are kept sparse, so that a field may be computed block by block and linked at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, length

Array = NDArray[np.float64]
Int = NDArray[np.int64]


TIP = 3.0
"""Ends side by side, so near (m) and looking the same way, are the tip of an outline."""


@dataclass(frozen=True)
class RidgePoints:
    """``xy`` (n, 2) m, ``direction`` (n, 2) unit vectors along the ridge (sign free), ``value``
    (n,) of the field, ``cell`` (n, 2) integer cell of the whole grid."""

    xy: Array
    direction: Array
    value: Array
    cell: Int

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, index: NDArray[np.bool_]) -> RidgePoints:
        """Some of the points."""
        return RidgePoints(
            self.xy[index], self.direction[index], self.value[index], self.cell[index]
        )

    @staticmethod
    def concatenate(parts: list[RidgePoints]) -> RidgePoints:
        """Points of several blocks."""
        names = ("xy", "direction", "value", "cell")
        return RidgePoints(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def ridge_points(
    field: Array, first_cell: Int, cell: float, blur: float, low: float
) -> RidgePoints:
    """Ridge points of ``field`` (rows y, columns x) where it is at least ``low``.

    ``first_cell`` (2,) is the integer cell (x, y) of ``field[0, 0]`` in the whole grid, ``cell``
    its size (m), ``blur`` (m) the Gaussian scale of the derivatives.
    """
    from scipy.ndimage import gaussian_filter1d

    scale = max(blur / cell, 0.8)
    by_row = [gaussian_filter1d(field, scale, 0, k, mode="constant") for k in range(3)]
    value = gaussian_filter1d(by_row[0], scale, 1, mode="constant")
    # Few cells are that high: derivatives are worked out for these alone.
    rows, columns = np.nonzero(value >= low)
    gx, gy, xx, xy, yy = _derivatives(by_row, rows, columns, scale)
    # Eigenvector of the most negative eigenvalue of [[xx, xy], [xy, yy]].
    half, mean = np.hypot((xx - yy) / 2, xy), (xx + yy) / 2
    curvature = mean - half
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    nx, ny = np.cos(angle), np.sin(angle)
    t = -(gx * nx + gy * ny) / np.where(curvature < -1e-15, curvature, -1e-15)
    ok = (curvature < -1e-12) & (np.abs(t * nx) <= 0.6) & (np.abs(t * ny) <= 0.6)
    rows, columns, t, nx, ny = rows[ok], columns[ok], t[ok], nx[ok], ny[ok]
    index = np.stack([columns, rows], axis=-1) + first_cell
    place = np.asarray((index + 0.5 + np.stack([t * nx, t * ny], -1)) * cell, np.float64)
    return RidgePoints(
        place,
        np.stack([-ny, nx], axis=-1),
        value[rows, columns],
        index.astype(np.int64),
    )


def _derivatives(by_row: list[Array], rows: Int, columns: Int, scale: float) -> list[Array]:
    """d/dx, d/dy, d²/dx², d²/dxdy, d²/dy² at cells, of a field whose Gaussian derivatives across
    the rows are ``by_row`` (orders 0, 1, 2); what lies beside the field is zero."""
    from scipy.ndimage import gaussian_filter1d

    reach = int(4 * scale + 0.5)
    spike = np.zeros(2 * reach + 1)
    spike[reach] = 1.0
    kernels = [gaussian_filter1d(spike, scale, order=k, mode="constant")[::-1] for k in range(3)]
    wanted = ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0))
    out = [np.zeros(len(rows)) for _ in wanted]
    padded = [np.pad(part, ((0, 0), (reach, reach))) for part in by_row]
    first = rows * padded[0].shape[1] + columns
    for step in range(2 * reach + 1):
        at = first + step
        values = [part.ravel()[at] for part in padded]
        for total, (y, x) in zip(out, wanted, strict=True):
            total += kernels[x][step] * values[y]
    return out


def trace(points: RidgePoints, high: float, shortest: float) -> list[Array]:
    """Link ridge points into polylines (n, 2): start at the strongest, follow both directions.

    A line starts at ``high`` or more and goes on to the edge of the points; lines shorter than
    ``shortest`` (m) are dropped. A line that runs into another ends there.
    """
    links, longest = _links(points)
    owner = [-1] * len(points)
    lines: list[Array] = []
    seeds = np.lexsort((points.cell[:, 1], points.cell[:, 0], -points.value))
    for name, seed in enumerate(seeds[points.value[seeds] >= high].tolist()):
        if owner[seed] >= 0:
            continue
        owner[seed] = name
        ahead = _walk(links, owner, seed, 0, name)
        behind = _walk(links, owner, seed, 1, name)
        # Most are specks; what follows makes them a little shorter or longer, not much.
        if (len(ahead) + len(behind)) * longest < 0.9 * shortest:
            continue
        raw = points.xy[[*behind[::-1], seed, *ahead]]
        if length(raw) < 0.9 * shortest:
            continue
        line = _smooth(raw)
        line = _straight_end(_straight_end(line)[::-1])[::-1]
        lines.append(line)
    return [line for line in lines if len(line) > 1 and length(line) >= shortest]


@dataclass(frozen=True)
class _Links:
    """Where a walk may go from point k along its direction (side 0) or against it (side 1):
    ``onward[side][first[side][k]:first[side][k + 1]]``, the best one first; ``turned`` says
    whether the next point's own direction runs against the walk. ``beside`` likewise: what lies
    beside a step from k and belongs to the same ridge."""

    onward: tuple[list[int], list[int]]
    turned: tuple[list[bool], list[bool]]
    first: tuple[list[int], list[int]]
    beside: list[int]
    beside_first: list[int]


def _links(points: RidgePoints) -> tuple[_Links, float]:
    """Neighbours within two cells, judged from every point in both directions at once, and the
    longest step (m) between two of them."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(points.cell).query_pairs(2.0, p=np.inf, output_type="ndarray")
    i, j = np.ascontiguousarray(np.concatenate([pairs, pairs[:, ::-1]]).T)
    step, d = points.xy[j] - points.xy[i], points.direction[i]
    forward = step[:, 0] * d[:, 0] + step[:, 1] * d[:, 1]
    across = np.abs(step[:, 0] * d[:, 1] - step[:, 1] * d[:, 0])
    cosine = (points.direction[j] * d).sum(axis=1)
    turn = np.abs(cosine)
    n = len(points)
    onward, turned, first = [], [], []
    for sign in (1.0, -1.0):
        ahead = sign * forward
        k = np.flatnonzero((ahead > 0) & (across < 1.2 * ahead) & (turn > 0.6))
        cost = ahead[k] + 2 * across[k] + (1 - turn[k])
        cell = points.cell[j[k]]
        k = k[np.lexsort((cell[:, 1], cell[:, 0], cost, i[k]))]
        onward.append(j[k].tolist())
        turned.append((cosine[k] <= 0).tolist())
        first.append(np.searchsorted(i[k], np.arange(n + 1)).tolist())
    k = np.flatnonzero((np.abs(forward) <= across) & (turn > 0.8))
    k = k[np.argsort(i[k], kind="stable")]
    longest = float(np.hypot(step[:, 0], step[:, 1]).max(initial=0.0))
    links = _Links(
        (onward[0], onward[1]),
        (turned[0], turned[1]),
        (first[0], first[1]),
        j[k].tolist(),
        np.searchsorted(i[k], np.arange(n + 1)).tolist(),
    )
    return links, longest


def _walk(links: _Links, owner: list[int], start: int, side: int, name: int) -> list[int]:
    """Indices of the ridge points that follow ``start`` on one side of it."""
    path: list[int] = []
    here = start
    while True:
        at, stop = links.first[side][here], links.first[side][here + 1]
        onward = links.onward[side]
        while at < stop and owner[onward[at]] == name:
            at += 1
        if at == stop:
            return path
        nearest = onward[at]
        path.append(nearest)
        if owner[nearest] >= 0:
            return path
        # What lies beside the step belongs to the same ridge: it must not start a line.
        for k in links.beside[links.beside_first[here] : links.beside_first[here + 1]]:
            if owner[k] < 0:
                owner[k] = name
        owner[nearest] = name
        # The direction of a point has no sign of its own: the walk goes on the way it came.
        side ^= links.turned[side][at]
        here = nearest


def _smooth(line: Array, sigma: float = 2.0) -> Array:
    """The steps of a few cells taken out of a traced line; its ends stay."""
    from scipy.ndimage import gaussian_filter1d

    if len(line) < 5:
        return line
    out = gaussian_filter1d(line, sigma, axis=0, mode="nearest")
    out[0], out[-1] = line[0], line[-1]
    return out


def _straight_end(line: Array, reach: float = 2.0, base: float = 5.0) -> Array:
    """The last ``reach`` metres put on the direction of the ``base`` metres before them.

    Where detections end the field is thin and its ridge wriggles; a line does not.
    """
    from_end = arc_length(line[::-1])[::-1]
    tail = from_end < reach
    body = (from_end >= reach) & (from_end < reach + base)
    if body.sum() < 6 or from_end[0] < reach + base:
        return line
    first, second = np.array_split(line[body], 2)
    origin, d = second.mean(axis=0), second.mean(axis=0) - first.mean(axis=0)
    d = d / max(float(np.hypot(*d)), 1e-9)
    out = line.copy()
    out[tail] = origin + ((line[tail] - origin) @ d)[:, None] * d
    return out


def _ends(lines: list[Array]) -> tuple[Array, Array]:
    """(2n, 2) end points and outward directions over the last eight metres of each line.

    From the mean of the outer to the mean of the inner half, so that a wriggle at the very end
    does not turn it.
    """
    place, outward = [], []
    for line in lines:
        for points in (line[::-1], line):
            far = np.hypot(*(points - points[-1]).T)
            reach = min(8.0, float(far.max()))
            outer = points[far <= reach / 2].mean(axis=0)
            inside = (far > reach / 2) & (far <= reach)
            # Lines of few vertices may have none there: then their far end.
            inner = points[inside].mean(axis=0) if inside.any() else points[far.argmax()]
            d = outer - inner
            place.append(points[-1])
            outward.append(d / max(float(np.hypot(*d)), 1e-9))
    return np.array(place).reshape(-1, 2), np.array(outward).reshape(-1, 2)


def join_collinear(
    lines: list[Array], gap: float, angle: float, corner: float = 0.0, firm: float = 0.0
) -> list[Array]:
    """Join lines whose ends look at each other: at most ``gap`` m apart, ``angle`` rad off.

    With ``corner`` > 0 (m) ends that meet at a corner are extended to where their tangents
    cross, if that is at most so far from both (boundaries turn sharply at junctions) and both
    are ``firm`` (m) long.
    """
    lines = list(lines)
    while len(lines) > 1:
        pairs = _joins(lines, gap, angle, corner, firm)
        if not pairs:
            break
        used: set[int] = set()
        merged: list[Array] = []
        for _, a, b, middle in pairs:
            # One join per line and round: its new ends are looked at in the next one.
            if a // 2 in used or b // 2 in used:
                continue
            used |= {a // 2, b // 2}
            first = lines[a // 2] if a % 2 else lines[a // 2][::-1]
            second = lines[b // 2][::-1] if b % 2 else lines[b // 2]
            between = [] if middle is None else [middle[None]]
            merged.append(np.concatenate([first, *between, second]))
        lines = [x for k, x in enumerate(lines) if k not in used] + merged
    return lines


def _joins(
    lines: list[Array], gap: float, angle: float, corner: float, firm: float
) -> list[tuple[float, int, int, Array | None]]:
    """Possible joins, cheapest first: cost, the two ends (2 · line, + 1 for its last point), and
    the corner between them or None."""
    from scipy.spatial import cKDTree

    place, outward = _ends(lines)
    size = [length(line) for line in lines]
    found = []
    for a, b in cKDTree(place).query_pairs(max(gap, 1.5 * corner), output_type="ndarray").tolist():
        if a // 2 == b // 2:
            continue
        turn = corner if min(size[a // 2], size[b // 2]) >= firm else 0.0
        cost = _join_cost(place[a], outward[a], place[b], outward[b], gap, angle, turn)
        if cost is not None:
            found.append((cost[0], a, b, cost[1]))
    return sorted(found, key=lambda j: j[:3])


def _join_cost(
    p: Array, d: Array, q: Array, e: Array, gap: float, angle: float, corner: float
) -> tuple[float, Array | None] | None:
    """Cost of joining two ends, with the corner between them or None; None when they do not."""
    step = q - p
    far = float(np.hypot(*step))
    facing = float(-(d @ e))
    if far <= gap and facing >= np.cos(angle):
        if far < 0.6:
            return far, None
        if min(d @ step, -(e @ step)) / far >= np.cos(angle):
            return far, None
    if corner > 0 and far <= TIP and facing < -0.7 and abs(float(d @ step)) <= TIP:
        # The two sides of a narrow island at its tip.
        return 2 * corner + far, None
    if corner > 0 and -0.5 < facing < np.cos(angle):
        cross = d[0] * e[1] - d[1] * e[0]
        if abs(cross) > 0.3:
            a = (step[0] * e[1] - step[1] * e[0]) / cross
            b = (step[0] * d[1] - step[1] * d[0]) / cross
            if -0.7 <= a <= corner and -0.7 <= b <= corner:
                return corner + abs(a) + abs(b), p + a * d
    return None
