"""Write schemas/*.json from the code: one description per kind of file that rtmap writes.

Tables are described by the TableSchema constants of the code and by notes.py; JSON files by
documents.py (JSON Schema). ``make schemas`` runs this; tests/test_schemas.py holds code and files
together.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
from pathlib import Path
from typing import Any

import documents
import notes

import rtmap_cli
from rtmap_cli.tables import TableSchema

FOLDER = Path(__file__).resolve().parent


def table_schemas() -> dict[str, TableSchema]:
    """Every TableSchema constant of the rooms that write tables, by name."""
    found: dict[str, TableSchema] = {}
    for room in ("maps", "logs", "formats", "steps.update"):
        package = importlib.import_module(f"rtmap_cli.{room}")
        for module in pkgutil.iter_modules(package.__path__, f"rtmap_cli.{room}."):
            for value in vars(importlib.import_module(module.name)).values():
                if isinstance(value, TableSchema):
                    found[value.name] = value
    return dict(sorted(found.items()))


def describe_table(schema: TableSchema) -> dict[str, Any]:
    """One table as JSON; KeyError names a column that notes.py does not explain."""
    meaning = notes.COMMON | notes.TABLES[schema.name]
    return {
        "name": schema.name,
        "version": schema.version,
        "format": "Parquet",
        "file": notes.FILES[schema.name],
        "description": schema.description,
        "frame": schema.frame or None,
        "units": schema.units or None,
        "metadata": sorted(schema.metadata()),
        "columns": [
            {"name": f.name, "type": str(f.type), "description": meaning[f.name]}
            for f in schema.columns
        ],
    }


def descriptions() -> dict[str, dict[str, Any]]:
    """File name → content of everything in schemas/."""
    out = {f"{name}.json": describe_table(s) for name, s in table_schemas().items()}
    out |= {f"{name}.json": value for name, value in documents.documents().items()}
    return out


def text(value: dict[str, Any]) -> str:
    """The content of one file."""
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"


def main() -> None:
    """Rewrite schemas/*.json; files of kinds that are no more are removed."""
    wanted = descriptions()
    for path in FOLDER.glob("*.json"):
        if path.name not in wanted:
            path.unlink()
    for name, value in wanted.items():
        (FOLDER / name).write_text(text(value), encoding="utf-8")
    print(f"{FOLDER}: {len(wanted)} files, rtmap {rtmap_cli.__version__}")


if __name__ == "__main__":
    main()
