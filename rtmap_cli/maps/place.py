"""Where a map lies. Every path of a map passes here, so that object stores have one door."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rtmap_cli.errors import BadInput
from rtmap_cli.tables import whole_file

LOG = "_delta_log"
TILES = "tiles"


@dataclass(frozen=True)
class Place:
    """A map folder on a local file system; names inside are relative, with forward slashes."""

    root: Path

    @staticmethod
    def of(path: str | Path) -> Place:
        """The place that a user named; BadInput for an address that is no local folder."""
        # pathlib folds the two slashes of s3://bucket into one.
        if re.match(r"[a-z][a-z0-9]+:/", str(path)):
            raise BadInput(path, "maps in object stores are not supported yet", "use a folder")
        # delta-rs 1.6 loses the history of folders with # or ?, and ends in a panic at [ or ].
        odd = re.search(r"[#?%\[\]]", str(Path(path).absolute()))
        if odd:
            raise BadInput(path, f"a map's path cannot hold {odd.group()!r}", "rename the folder")
        return Place(Path(path))

    @property
    def uri(self) -> str:
        """What deltalake opens."""
        return str(self.root.absolute())

    def file(self, name: str) -> Path:
        """The path of a file inside; BadInput for a name that leads out of the map."""
        # Names come from the log of a map that somebody else may have written.
        if PurePosixPath(name).is_absolute() or ".." in name.split("/") or ":" in name:
            raise BadInput(self.root, f"its log names {name!r}, which is not inside the map")
        return self.root / name

    def exists(self, name: str) -> bool:
        """True when the file is there."""
        return self.file(name).is_file()

    def write(self, name: str, data: bytes) -> None:
        """Write a file whole: a crash never leaves half of it under its name."""
        with whole_file(self.file(name)) as temporary:
            temporary.write_bytes(data)

    def read(self, name: str) -> bytes:
        """The content of a file."""
        return self.file(name).read_bytes()

    def remove(self, name: str) -> None:
        """Remove a file; its folder too when it was the last one there."""
        path = self.file(name)
        path.unlink(missing_ok=True)
        if path.parent != self.root and not any(path.parent.iterdir()):
            path.parent.rmdir()

    def data_files(self) -> list[tuple[str, int, float]]:
        """(name, bytes, age in seconds) of every file among the tiles, sorted by name."""
        now = time.time()
        out = []
        for path in sorted((self.root / TILES).rglob("*")):
            if path.is_file():
                state = path.stat()
                name = path.relative_to(self.root).as_posix()
                out.append((name, state.st_size, now - state.st_mtime))
        return out

    def log_files(self) -> list[str]:
        """The JSON commits, oldest first."""
        return sorted(f"{LOG}/{p.name}" for p in (self.root / LOG).glob("*.json"))
