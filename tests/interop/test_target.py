"""The targets of an export."""

from dataclasses import astuple
from fractions import Fraction

import pytest
from support.plants import ROOT
from support.written_files import ORACLES, WITHOUT_ORACLE, is_schur, judge

import lbt_synth as lbt
from lbt_synth.interop.target import target_names

CHUNK = 100


@pytest.mark.parametrize("name", target_names())
def test_a_target_says_how_it_computes(name):
    target = lbt.interop.target_named(name)
    assert all(text and text.isascii() for text in astuple(target.arithmetic))
    assert target.write.__name__.startswith("export_")


def test_the_page_has_the_table_of_the_targets():
    page = (ROOT / "docs" / "real_time_computer.md").read_text()
    for name in target_names():
        words = astuple(lbt.interop.target_named(name).arithmetic)
        assert f"* - `{name}`\n" + "".join(f"  - {text}\n" for text in words) in page


def test_each_folder_with_an_export_is_a_target_and_has_an_oracle():
    assert {"c", "cacao", "dao", "matlab", "pyrtc"} <= set(target_names())
    assert set(target_names()) <= set(ORACLES) | WITHOUT_ORACLE
    assert not set(ORACLES) & WITHOUT_ORACLE


@pytest.mark.usefixtures("short_rehearsal")
def test_the_oracles_see_a_loop_that_is_unstable(tmp_path):
    """Files of an integrator, judged in the loop of one that is too slow for it."""
    quick = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.9)
    late = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=3), gain=0.1)
    options = {"precision": "double", "form": "plain"}
    for name, oracle in ORACLES.items():
        if name == "cacao":  # its configuration has the delay, so that this loop has none to miss
            continue
        target = lbt.interop.target_named(name)
        files = target.write(target.path_in(tmp_path), quick).files
        assert oracle(files, quick, options)
        assert not oracle(files, late, options)


def test_polynomials_are_judged_exactly():
    near = Fraction(2**60 - 1, 2**60)
    assert is_schur([Fraction(1), -near])
    assert not is_schur([Fraction(1), Fraction(-1)])
    assert is_schur([Fraction(1), -2 * near, near**2, Fraction(0)])
    assert not is_schur([Fraction(1), -2 * near, 1 + Fraction(1, 2**100)])


def written_stable(folder, seeds):
    """Require that no file of these gain files is unstable; return how many were written."""
    written = dict.fromkeys(ORACLES, 0)
    for seed in seeds:
        for name, verdict in judge(folder, seed).items():
            assert verdict is not False, (name, seed)
            written[name] += verdict is not None
    return written


@pytest.mark.usefixtures("short_rehearsal")
def test_no_target_writes_an_unstable_file(tmp_path):
    assert all(written_stable(tmp_path, [6]).values())


@pytest.mark.study
@pytest.mark.parametrize("chunk", range(100))
@pytest.mark.usefixtures("short_rehearsal")
def test_no_target_writes_one_of_ten_thousand(tmp_path, chunk):
    seeds = range(CHUNK * chunk, CHUNK * (chunk + 1))
    assert all(written_stable(tmp_path, seeds).values())
