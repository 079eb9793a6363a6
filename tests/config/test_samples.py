"""A configuration whose builders declare what they take for each sample."""

import numpy as np
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.config.samples import Reads, SampleView, accepted_by_schema
from lbt_synth.config.schema import ModelSection


def view(values=None):
    reads = Reads()
    return SampleView(lbt.load_config(LBT_YAML).settings, reads, values or {}), reads


def test_a_number_that_one_builder_needs_alone_takes_no_arrays():
    settings, reads = view()
    photons = ("sensor", "pyramid", "photons")
    assert settings.sensor.per_sample.pyramid.photons == 50
    assert reads.take_arrays_at(photons)
    settings.sensor.pyramid.model_dump(exclude={"photons"})
    assert reads.take_arrays_at(photons)
    settings.sensor.require_one_value()
    assert not reads.take_arrays_at(photons)


def test_numbers_of_lists_take_no_arrays():
    settings, reads = view()
    assert settings.robustness.per_sample.delay_errors_frames == [0.0]
    assert not reads.take_arrays_at(("robustness", "delay_errors_frames", 0))


def test_a_view_has_the_kind_and_the_properties_of_its_section():
    keys = ("model", "vibrations", 0, "rms_mas")
    settings, reads = view({keys: np.array([1.0, 2.0])})
    assert isinstance(settings.model, ModelSection)
    assert settings.true_turbulence == "frozen_flow"
    assert ("truth", "turbulence") in reads.shared
    line = settings.model.vibrations[0]
    assert line.per_sample.rms_mas.tolist() == [1.0, 2.0]
    assert isinstance(line.rms_mas, float)


def test_the_schema_checks_many_values_at_once():
    settings = lbt.load_config(LBT_YAML).settings
    values = np.array([1.0, 0.0, -1.0, np.nan, np.inf, 2.0])
    for keys in (("model", "sensor_gain"), ("atmosphere", "outer_scale_m")):
        found = accepted_by_schema(settings, keys, values)
        assert np.flatnonzero(found).tolist() == [0, 5]
