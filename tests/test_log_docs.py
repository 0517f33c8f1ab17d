"""What docs/log-format.md promises: the converter in it runs, and its log passes the checker."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from sample_logs import jpeg

from rtmap_cli.logs.native import NativeLog
from rtmap_cli.logs.tables import FRAMES, IMAGES, LIDAR, RIG, SWEEP

PAGE = Path(__file__).resolve().parents[1] / "docs" / "log-format.md"


def test_converter(rtmap: Callable[..., Any], tmp_path: Path, monkeypatch: Any) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    rows = ["timestamp_ns,lon,lat,height,heading_deg"]
    (tmp_path / "drive/front").mkdir(parents=True)
    for i in range(10):  # 10 m to the north each second
        time = 1_700_000_000_000_000_000 + i * 1_000_000_000
        rows.append(f"{time},9.0,{48 + i * 10 / 111_190:.9f},512.5,0.0")
        (tmp_path / f"drive/front/{time}.jpg").write_bytes(jpeg(20 * i, (1920, 1080)))
    (tmp_path / "drive/poses.csv").write_text("\n".join(rows))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(PAGE), "exec"), {})
    told = json.loads(rtmap("check-log", "logs/monday", "--json").out)
    assert told["findings"] == []
    log = NativeLog(Path("logs/monday"))
    assert len(log) == 10 and log.rig is not None
    first, second = list(log.frames())[:2]
    step = second.map_SE3_ego[:2, 3] - first.map_SE3_ego[:2, 3]
    assert step == pytest.approx([0, 10], abs=0.05)
    assert pq.read_schema("logs/monday/frames.parquet").metadata[b"rtmap.crs"] == b"EPSG:32632"


@pytest.mark.parametrize("schema", [FRAMES, IMAGES, LIDAR, RIG, SWEEP], ids=lambda s: s.name)
def test_every_column_is_described(schema: Any) -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name in schema.columns.names:
        stem = name.replace("odometry_sigma_", "odometry_sigma_…").split("…")[0]
        described = f"`{name}`" in text or (stem != name and stem in text)
        assert described or name in ("y", "z", "qw", "qx", "qy"), name
