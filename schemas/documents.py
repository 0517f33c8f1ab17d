"""The JSON and GeoJSON files of rtmap as JSON Schema (draft 2020-12)."""

from __future__ import annotations

from typing import Any

from rtmap_cli.formats.change_file import STATES
from rtmap_cli.formats.changes import CHANGES_SCHEMA, CHANGES_VERSION, KINDS
from rtmap_cli.formats.geojson import GEOJSON_SCHEMA, GEOJSON_VERSION
from rtmap_cli.logs.run import RUN_SCHEMA, RUN_VERSION
from rtmap_cli.logs.semantic import CLASSES, SEMANTIC_SCHEMA, SEMANTIC_VERSION
from rtmap_cli.logs.tables import LOG_SCHEMA, LOG_VERSION
from rtmap_cli.maps.delta import MAP_FORMAT, MAP_VERSION
from rtmap_cli.maps.footprint import ORIGINS, PREFIX, ZOOM
from rtmap_cli.steps.update.compare import REASONS

DRAFT = "https://json-schema.org/draft/2020-12/schema"

Node = dict[str, Any]


def _text(description: str) -> Node:
    return {"type": "string", "description": description}


def _number(description: str) -> Node:
    return {"type": "number", "description": description}


def _integer(description: str) -> Node:
    return {"type": "integer", "description": description}


def _numbers(description: str) -> Node:
    return {"type": "array", "items": {"type": ["number", "null"]}, "description": description}


def _texts(description: str) -> Node:
    return {"type": "array", "items": {"type": "string"}, "description": description}


def _or_null(node: Node) -> Node:
    return node | {"type": [node["type"], "null"]}


def _object(properties: Node, required: list[str], description: str = "", **more: Any) -> Node:
    out: Node = {"type": "object", "properties": properties, "required": required, **more}
    return out | ({"description": description} if description else {})


def _versioned(name: str, version: str) -> Node:
    return {
        "schema": {"const": name},
        "schema_version": {
            "type": "string",
            "description": f"major.minor; this is {version}, readers refuse another major version",
        },
    }


def _document(title: str, file: str, node: Node) -> Node:
    return {"$schema": DRAFT, "title": title, "file": file, **node}


def _run() -> Node:
    span = {"type": "array", "items": {"type": "number"}, "description": "minimum, maximum, m"}
    properties = _versioned(RUN_SCHEMA, RUN_VERSION) | {
        "rtmap_version": _text("the rtmap that wrote it"),
        "log_id": _text("identity of the traversal"),
        "crs": _text("CRS of all poses and map-frame points of the run"),
        "classes": _texts("classes, in the order of the model's indices"),
        "range_m": _object({"x": span, "y": span}, ["x", "y"], "ego-frame range"),
        "ego_frame": _text("x forward, y left, z up, metres"),
    }
    needed = list(properties)
    properties["ground_z"] = _number("height of the road in the ego frame, m, where it is known")
    properties["model_footprint"] = _footprint()
    description = "How a run was made; further members say by what (model, options, map_version …)."
    return _document(RUN_SCHEMA, "RUN/run.json", _object(properties, needed, description))


def _footprint() -> Node:
    properties = {
        "origins": {"type": "array", "items": {"enum": list(ORIGINS)}, "description": "of frames"},
        "zoom": {"const": ZOOM, "description": "web-mercator zoom of the cells"},
        "cells": {
            "type": "object",
            "description": f"the first {PREFIX} digits of quadkeys: the rest of each, by spaces",
        },
    }
    said = "what the training of the model saw (docs/model-contract.md), where infer made the run"
    return _object(properties, list(properties), said)


def _log() -> Node:
    properties = _versioned(LOG_SCHEMA, LOG_VERSION) | {
        "log_id": _text("identity of the drive"),
        "crs": _text("CRS of its poses"),
        "ground_z": _number("height of the road under the vehicle in the ego frame, m"),
        "ego_frame": _text("what the axes of the ego frame are"),
        "map_frame": _text("what the axes of the map frame are"),
        "camera_frame": _text("what the axes of a camera frame are"),
        "time": _text("what timestamps count"),
        "creation": {"type": "object", "description": "who made it and how"},
    }
    required = ["schema", "schema_version", "log_id", "crs", "ground_z"]
    return _document(
        LOG_SCHEMA, "LOG/log.json", _object(properties, required, "What a native log is.")
    )


def _semantic() -> Node:
    window = {
        "half_x": _number("half the length of the ego window, m"),
        "half_y": _number("half its width, m"),
        "cell": _number("size of a cell, m"),
        "rows": _integer("cells from right to left"),
        "columns": _integer("cells from rear to front"),
        "planes": _texts("planes of a raster from top to bottom: the classes, then evidence"),
        "layout": _text("where which cell lies in the PNG files"),
        "values": _text("what the values of the planes mean"),
    }
    properties = _versioned(SEMANTIC_SCHEMA, SEMANTIC_VERSION) | {
        "log_id": _text("identity of the drive"),
        "crs": _text("CRS of its poses and cells"),
        "classes": _texts("classes of the ground, in the order of the planes"),
        "colours": {"type": "object", "description": "red, green, blue of each class in pictures"},
        "cell": _number("size of a cell of the map, m"),
        "window": _object(window, list(window), "the rasters of frames"),
        "creation": {"type": "object", "description": "who made it and how"},
    }
    about = "What a semantic map is."
    node = _object(properties, list(properties), about)
    return _document(SEMANTIC_SCHEMA, "SEMANTIC/semantic.json", node)


def _labels() -> Node:
    label = _object(
        {
            "name": _text("name of the label; its place in the list is the number in masks"),
            "class": {"enum": [*CLASSES, "ignore"], "description": "what it means for the ground"},
        },
        ["name"],
    )
    entry = {"type": "array", "items": label, "description": "labels from number 0 on"}
    network = {"type": "object", "description": "mean, std, size of a network's input"}
    node = _object({"labels": entry, "input": network}, ["labels"], "What masks mean.")
    return _document("rtmap.labels", "LOG/masks/labels.json", node)


def _geometry(*kinds: str) -> Node:
    properties = {
        "type": {"enum": list(kinds)},
        "coordinates": {"type": "array", "description": "WGS84 longitude, latitude, height (m)"},
    }
    return _object(properties, ["type", "coordinates"])


def _collection(properties: Node, required: list[str], geometry: Node, **members: Node) -> Node:
    feature = _object(
        {
            "type": {"const": "Feature"},
            "properties": _object(properties, required),
            "geometry": geometry,
        },
        ["type", "properties", "geometry"],
    )
    return _object(
        {
            "type": {"const": "FeatureCollection"},
            "features": {"type": "array", "items": feature},
            **members,
        },
        ["type", "features"],
    )


def _map_geojson() -> Node:
    own = _object(
        _versioned(GEOJSON_SCHEMA, GEOJSON_VERSION)
        | {
            "crs_of_map": _text("CRS of the map it was exported from"),
            "map_version": _or_null(_integer("version of that map")),
            "frame": _text("what the coordinates are"),
            "units": _text("units of the properties"),
        },
        ["schema", "schema_version", "crs_of_map"],
        "written by `rtmap export geojson`; other files need not have it",
    )
    properties = {
        "id": _text("element_id"),
        "class": _text("class of the element"),
        "sigma_m": _numbers("standard deviation per vertex, each horizontal axis, m"),
        "covariance_m2": {
            "type": "array",
            "items": _numbers("xx, xy, yy, zz"),
            "description": "covariance per vertex, m², axes of crs_of_map; null: unknown",
        },
        "existence": _number("log-odds that the element exists"),
        "seen": _integer("frames in which it was seen"),
        "in_view": _integer("frames in which it was in view"),
        "traversals": _integer("drives that had it in view"),
        "first_seen_ns": _or_null(_integer("ns since 1970-01-01T00:00:00Z")),
        "last_seen_ns": _or_null(_integer("ns since 1970-01-01T00:00:00Z")),
        "runs": _texts("ids of the runs behind it"),
        "model_sha256": _text("SHA-256 of the network that saw it"),
        "attributes": {"type": "object", "description": "attributes with a name of this list"},
    }
    node = _collection(properties, ["class"], _geometry("LineString", "Polygon"), rtmap=own)
    return _document(GEOJSON_SCHEMA, "what `rtmap export geojson` writes", node)


def _changes_geojson() -> Node:
    properties = {
        "id": _text("the same as change_id"),
        "change_id": _text("id of the change"),
        "kind": {"enum": list(KINDS), "description": "seen from the map"},
        "class": _text("class of the element"),
        "element_id": _or_null(_text("map element that is gone or modified")),
        "probability": _number("that the change is real"),
        "log_odds": _number("the same as log-odds"),
        "frames_seen": _integer("frames that support it"),
        "frames_in_view": _integer("frames that could have seen it"),
        "traversals_seen": _integer("drives that support it"),
        "traversals_in_view": _integer("drives that could have seen it"),
        "first_seen_ns": _or_null(_integer("ns since 1970-01-01T00:00:00Z")),
        "last_seen_ns": _or_null(_integer("ns since 1970-01-01T00:00:00Z")),
        "runs": _texts("ids of the runs behind it"),
        "evidence": {"type": "array", "items": _drive_evidence()},
    }
    needed = list(properties)
    properties["map_version"] = _integer("version of the map that the change is about")
    properties["reason"] = {"enum": list(REASONS), "description": "why `rtmap update` tells it"}
    properties["review"] = {"enum": list(STATES), "description": "decision; not there: open"}
    stated = _versioned(CHANGES_SCHEMA, CHANGES_VERSION) | {
        "map_version": _integer("version of the map that the changes are about"),
        "crs_of_map": _text("CRS of that map"),
    }
    own = _object(stated, ["schema", "schema_version"])
    geometry = _geometry("LineString", "Polygon")
    node = _collection(properties, needed, geometry, rtmap=own)
    return _document(CHANGES_SCHEMA, "what `rtmap detect-changes` and `update` write", node)


def _drive_evidence() -> Node:
    """What one drive says about a change."""
    properties = {
        "run": _text("id of the run"),
        "frames_seen": _integer("frames that found the element"),
        "frames_in_view": _integer("frames that could have"),
        "seen_ns": {"type": "array", "items": _integer("time of a frame that found it")},
        "score": _or_null(_number("mean score of what they found")),
        "log_odds": _number("that the element exists, by this run alone"),
        "found": {"type": "boolean", "description": "its vote"},
    }
    return _object(properties, list(properties))


def _map_properties() -> Node:
    properties = {
        "format": {"const": MAP_FORMAT},
        "version": _text(f"major.minor; this is {MAP_VERSION}"),
        "crs": _text("CRS of the map frame: projected, metres"),
        "tile_zoom": _integer("web-mercator zoom of the quadkeys"),
    }
    description = "The JSON text in the description of the Delta table."
    return _document(
        MAP_FORMAT, "MAP/_delta_log", _object(properties, list(properties), description)
    )


def documents() -> dict[str, Node]:
    """Schema name → JSON Schema."""
    found = [
        _run(),
        _log(),
        _semantic(),
        _labels(),
        _map_geojson(),
        _changes_geojson(),
        _map_properties(),
    ]
    return {node["title"]: node for node in found}
