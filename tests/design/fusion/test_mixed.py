"""The mixed filter of several sensors, between the H-infinity and the Kalman filter."""

import pytest

import lbt_synth as lbt
from lbt_synth.errors import InfeasibleError, ProblemError


@pytest.mark.parametrize("ratio", [1.02, 1.1])
def test_it_lies_between_the_two(fused_config, fused, ratio):
    plant = fused_config.fused_plant
    central = lbt.design.fused_hinf(plant, gamma_ratio=ratio)
    mixed = lbt.design.fused_mixed(plant, gamma_ratio=ratio)
    assert fused.rms < mixed.rms < central.rms
    assert central.gamma < mixed.gamma <= mixed.gamma_requested * (1 + 1e-9)
    assert mixed.gamma == pytest.approx(mixed.gamma_requested, rel=1e-5)


def test_a_bound_that_the_kalman_filter_meets(fused_config, fused):
    found = lbt.design.fused_mixed(fused_config.fused_plant, gamma=1.01 * fused.gamma)
    assert found.method == "fused kalman"
    assert found.rms == pytest.approx(fused.rms, rel=1e-12)


def test_a_bound_below_the_least(fused_config):
    with pytest.raises(InfeasibleError, match="gamma must be at least"):
        lbt.design.fused_mixed(fused_config.fused_plant, gamma=1.0)


def test_a_configuration_and_its_gain_file(fused_config, tmp_path):
    design = fused_config.design("mixed", gamma_ratio=1.05)
    again = lbt.load_gain(lbt.save_gain(tmp_path / "mixed.npz", design))
    assert (again.method, again.gamma_central) == ("fused mixed", design.gamma_central)
    with pytest.raises(ProblemError, match="rms must be left out with several sensors"):
        fused_config.design("mixed", rms=50.0)
