"""Fields: polygon, ROIs and starts of an environment, from a file, from Python, or at random."""

from __future__ import annotations

from mbn_marl.field.field import Field
from mbn_marl.field.files import (
    catalogue_names,
    load_field,
    load_fields,
    sampler_names,
    save_field,
)
from mbn_marl.field.from_map import load_map
from mbn_marl.field.generator.sampler import FieldSampler, generate
from mbn_marl.field.schema import FORMAT, json_schema
from mbn_marl.field.splits import Instance, load_split

__all__ = [
    "FORMAT",
    "Field",
    "FieldSampler",
    "Instance",
    "catalogue_names",
    "generate",
    "json_schema",
    "load_field",
    "load_fields",
    "load_map",
    "load_split",
    "sampler_names",
    "save_field",
]
