"""The JSON schema of a configuration: what editors read."""

from lbt_synth.config.schema import config_schema

SCHEMA = config_schema()
UNITS = {f"_{unit}": f"[{unit}]" for unit in ("mas", "m", "um", "deg", "arcsec", "frames")}
UNITS |= {"_hz": "[Hz]", "_nm": "[nm"}
COUNTS = {"settle_frames"}  # of frames, not in frames


def test_editors_know_every_key_with_its_unit_and_what_is_required():
    for section in (SCHEMA, *SCHEMA["$defs"].values()):
        for key, value in section.get("properties", {}).items():
            assert value["description"]
            for ending, unit in UNITS.items():
                if key.endswith(ending) and key not in COUNTS and "sensor_gain" not in key:
                    assert unit in value["description"], key
    for section in (SCHEMA, SCHEMA["$defs"]["LoopSection"]):
        assert section["additionalProperties"] is False
    assert SCHEMA["$schema"].endswith("2020-12/schema")
    assert SCHEMA["$defs"]["LoopSection"]["required"] == ["frame_rate_hz"]
    assert SCHEMA["$defs"]["TelescopeSection"]["properties"]["diameter_m"]["maximum"] == 1000
