"""The JSON schema of a configuration: what editors read."""

import pytest
from ruamel.yaml import YAML

import lbt_synth as lbt
from lbt_synth.config.load import example_files, telescope_names, telescope_template

SCHEMA = lbt.config.config_schema()
SECTIONS = [SCHEMA, *SCHEMA["$defs"].values()]
UNITS = {
    "_hz": "[Hz]",
    "_nm": "[nm",
    "_mas": "[mas]",
    "_m": "[m]",
    "_um": "[um]",
    "_deg": "[deg]",
    "_arcsec": "[arcsec]",
    "_frames": "[frames]",
}
COUNTS = {"settle_frames"}  # of frames, not in frames


def choices(schema):
    """What a part of the schema may be, references and alternatives followed."""
    if "$ref" in schema:
        return choices(SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]])
    parts = [part for word in ("oneOf", "anyOf", "allOf") for part in schema.get(word, [])]
    return [found for part in parts for found in choices(part)] if parts else [schema]


def fits(value, schema):
    """Whether the schema takes a value: its types, keys, and required keys."""
    return any(fits_one(value, one) for one in choices(schema))


def fits_one(value, one):
    """Whether one of its alternatives does."""
    if isinstance(value, dict):
        others = one.get("additionalProperties")  # of names that the file chooses
        known = one.get("properties", {}) if not others else dict.fromkeys(value, others)
        there = value.keys() <= known.keys() and set(one.get("required", ())) <= value.keys()
        return there and all(fits(inner, known[key]) for key, inner in value.items())
    if isinstance(value, list):
        return one.get("type") == "array" and all(fits(inner, one["items"]) for inner in value)
    if isinstance(value, str):
        choice = one.get("enum", [one.get("const")])
        return value in choice or (choice == [None] and one.get("type") == "string")
    if value is None:
        return one.get("type") == "null"
    return one.get("type") in ("number", "integer") and value >= one.get("minimum", value)


def test_every_key_has_a_description_with_its_unit():
    for section in SECTIONS:
        for key, value in section.get("properties", {}).items():
            assert value["description"]
            for ending, unit in UNITS.items():
                if key.endswith(ending) and key not in COUNTS and "sensor_gain" not in key:
                    assert unit in value["description"], key


@pytest.mark.parametrize("name", telescope_names())
def test_templates_fit(name):
    content = YAML(typ="safe", pure=True).load(telescope_template(name))
    assert fits(content, SCHEMA)
    content["loop"]["frame_rate_khz"] = 1.0
    assert not fits(content, SCHEMA)


def test_examples_fit():
    for name, text in example_files().items():
        if name != "study.yaml":
            assert fits(YAML(typ="safe", pure=True).load(text), SCHEMA)
