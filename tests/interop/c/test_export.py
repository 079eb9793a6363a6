"""The exported C source, compiled and run beside the controller."""

import os
import re
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.compiled import STRICT, Compiled, compiler
from support.exports import bare_design, lbt_config, lbt_designs, relative

import lbt_synth as lbt
from lbt_synth.interop.c.arithmetic import SourceTerms
from lbt_synth.interop.export_checks import rehearsal_error

FRAMES = 3000
LIMITS = {"double": 1e-12, "single": 1e-5}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Function that writes ``ctl.c`` of a design and a precision, each of them once."""

    @cache
    def write(name, precision="double"):
        target = tmp_path_factory.mktemp("exported") / "ctl.c"
        return lbt.interop.export_c(target, lbt_designs()[name], precision=precision)

    return write


@cache
def own_commands(name):
    """Commands of a design in the loop of the configuration, which no export changes."""
    return loop_commands(lbt_designs()[name].controller.start())


def loop_commands(stepped):
    """Commands of a controller in the loop of the configuration."""
    run = lbt.simulate(
        stepped, lbt_config().truth, hardware=lbt_config().hardware, frames=FRAMES, settle_frames=0
    )
    return run.commands


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "prior", "turned"])
def test_the_compiled_controller_closes_the_loop(exported, name, precision):
    """Same disturbance and noise for thousands of frames, in a loop: some are unstable alone."""
    single = precision == "single"
    written = exported(name, precision)
    expected = own_commands(name)
    assert np.max(np.abs(expected)) > 100  # nm
    error = relative(loop_commands(Compiled(written.files[0], single=single)), expected)
    assert error < LIMITS[precision]
    if single:  # what the file says of itself, met in another loop
        assert written.error / 10 < error < 10 * written.error


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("name", ["kalman", "hinf", "prior", "turned"])
def test_the_rehearsal_is_the_arithmetic_of_the_source(exported, designs, name, precision):
    """Bit for bit in the loop, and the reported error is that of the compiled source."""
    design, single = designs[name], precision == "single"
    written = exported(name, precision)
    theirs = Compiled(written.files[0], single=single)
    assert rehearsal_error(design, theirs) == written.error
    assert 0 < written.error < LIMITS[precision]
    if single:
        assert written.error_single == written.error
    else:
        assert 1e-9 < written.error_single < LIMITS["single"]
    ours = SourceTerms(design.controller, np.float32 if single else np.float64)
    theirs.reset()
    for y in np.random.default_rng(6).standard_normal((50, 2)):
        assert np.array_equal(ours.step(y), theirs.step(y))


@pytest.mark.parametrize("precision", LIMITS)
def test_the_compiled_integrator_on_given_measurements(exported, designs, precision):
    written = exported("integrator", precision)
    theirs = Compiled(written.files[0], single=precision == "single")
    ours = designs["integrator"].controller.start()
    series = np.random.default_rng(1).standard_normal((FRAMES, 2))
    found = [theirs.step(y) for y in series]
    assert relative(found, np.array([ours.step(y) for y in series])) < LIMITS[precision]


@st.composite
def controllers(draw):
    """Stable controllers of all shapes: sparse and dense, zero rows, signs, no feedthrough."""
    n, q, m = (draw(st.integers(1, high)) for high in (22, 4, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    density = draw(st.sampled_from([0.0, 0.2, 0.6, 1.0]))

    def matrix(rows, columns):
        values = rng.standard_normal((rows, columns)) * (rng.random((rows, columns)) < density)
        return np.where(rng.random((rows, columns)) < 0.1, np.sign(values), values)

    A = matrix(n, n)
    if draw(st.booleans()):
        A[rng.integers(n)] = 0
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    A = A if radius < 0.9 else A * (0.9 / radius)
    D = matrix(m, q) * draw(st.booleans())
    return lbt.Controller(A=A, B=matrix(n, q), C=matrix(m, n), D=D, dt_s=0.002)


@pytest.mark.usefixtures("short_rehearsal")
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(controller=controllers(), precision=st.sampled_from(list(LIMITS)))
def test_any_stable_controller(tmp_path, controller, precision):
    written = lbt.interop.export_c(tmp_path / "any.c", bare_design(controller), precision=precision)
    theirs = Compiled(written.files[0], single=precision == "single")
    ours = controller.start()
    series = np.random.default_rng(2).standard_normal((200, controller.B.shape[1]))
    expected = np.array([ours.step(y) for y in series])
    found = np.array([theirs.step(y) for y in series])
    states = max(1.0, float(np.max(np.abs(ours.state))))
    size = max(float(np.max(np.abs(expected))), states)
    assert np.max(np.abs(found - expected)) < LIMITS[precision] * size


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_two_loops_at_once_do_not_meet(exported, designs, name):
    source = exported(name).files[0]
    one = Compiled(source)
    two = Compiled(source, library=one.library)
    alone = [designs[name].controller.start() for _ in range(2)]
    series = np.random.default_rng(3).standard_normal((60, 2, 2))
    for pair in series:
        for instance, own, y in zip((one, two), alone, pair, strict=True):
            assert np.allclose(instance.step(y), own.step(y), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_a_measurement_that_is_not_finite_holds_command_and_state(exported, name, precision):
    source = exported(name, precision).files[0]
    theirs, undisturbed = (Compiled(source, single=precision == "single") for _ in range(2))
    before = np.zeros(2)
    for k, y in enumerate(np.random.default_rng(4).standard_normal((20, 2))):
        for bad in (np.nan, np.inf, -np.inf):
            state = theirs.state.copy()
            theirs.u[:] = 99.0
            assert np.array_equal(theirs.step([bad, 1.0] if k % 2 else [1.0, bad]), before)
            assert theirs.held == 1
            assert np.array_equal(theirs.state, state)
        before = undisturbed.step(y)
        assert np.array_equal(theirs.step(y), before)
        assert theirs.held == undisturbed.held == 0


def test_a_command_is_held_where_it_shares_its_array_with_the_measurements(exported):
    theirs = Compiled(exported("kalman").files[0])
    last = theirs.step([1.0, -2.0])
    both = np.array([3.0, np.nan])
    assert theirs._call("step", theirs.state, both, both) == 1
    assert np.array_equal(both, last)


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_reset_forgets(exported, name):
    theirs = Compiled(exported(name).files[0])
    series = np.random.default_rng(4).standard_normal((20, 2))
    first = [theirs.step(y) for y in series]
    theirs.reset()
    assert np.array_equal(theirs.step([np.nan, 1.0]), [0.0, 0.0])
    assert np.array_equal([theirs.step(y) for y in series], first)


def test_flags_that_hide_such_measurements_are_refused(tmp_path, exported):
    source = exported("integrator").files[0]
    command = [compiler(), "-std=c99", "-ffast-math", "-c", source, "-o", tmp_path / "ctl.o"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


def test_measurements_and_commands_in_one_array(exported, designs):
    for name in ("kalman", "turned"):
        theirs = Compiled(exported(name).files[0])
        ours = designs[name].controller.start()
        for y in np.random.default_rng(5).standard_normal((5, 2)):
            both = y.copy()
            theirs._call("step", theirs.state, both, both)
            assert np.allclose(both, ours.step(y), rtol=1e-12, atol=1e-12)


def test_the_header_is_fit_for_cpp(tmp_path, exported):
    source = exported("kalman", "single").files[0]
    user = tmp_path / "user.cpp"
    user.write_text(
        '#include "ctl.h"\n#include "ctl.h"\n'
        "int main() { ctl_state s; float y[CTL_MEASUREMENTS] = {0}, u[CTL_COMMANDS];\n"
        "ctl_reset(&s); ctl_step(&s, y, u); return u[0] == 0.0f ? 0 : 1; }\n"
    )
    flags = ["-pedantic", "-Wall", "-Wextra", "-Werror", "-I", source.parent]
    subprocess.run([compiler(), *STRICT, "-c", source, "-o", tmp_path / "ctl.o"], check=True)
    program = tmp_path / "user"
    subprocess.run(
        [compiler("c++"), "-std=c++98", *flags, user, tmp_path / "ctl.o", "-o", program], check=True
    )
    subprocess.run([program], check=True)


def test_coefficients_are_exact_and_explained(exported, designs):
    controller = designs["kalman"].controller
    text = exported("kalman").files[0].read_text()
    found = re.findall(r"(-?0x\S+p[+-]\d+), /\* ([ABCD])\[(\d+)\]\[(\d+)\] = (\S+) \*/", text)
    assert len(found) == lbt.interop.frame_cost(controller).coefficients
    for code, name, i, j, decimal in found:
        value = getattr(controller, name)[int(i), int(j)]
        assert float.fromhex(code) == value == float(decimal)


def test_the_comment_says_where_it_comes_from(tmp_path, designs):
    sha = "ab" * 32
    written = lbt.interop.export_c(tmp_path / "k.c", designs["kalman"], gain_digest=sha)
    for file in written.files[:2]:
        text = file.read_text()
        for part in (lbt.__version__, "kalman (riccati)", sha, "800.0 Hz", "2.0 frames", "nm rms"):
            assert part in text
        assert f"{len(designs['kalman'].certificate.checks)} checks passed" in text
    assert f'#define K_GAIN_SHA256 "{sha}"' in written.files[1].read_text()


@pytest.mark.usefixtures("short_rehearsal")
@pytest.mark.parametrize(
    "evil", ["*/ int main(void) {} /*", "x\\\n*/", "??/", "*\n/ #error", "\u202e*/", 'a"b', "\x00"]
)
def test_words_cannot_leave_the_comment(tmp_path, designs, evil):
    check = lbt.design.Check(name=evil, value=0.0, limit=1.0, computed_by=evil)
    design = replace(
        designs["integrator"],
        method=evil,
        solver=lbt.design.SolverReport(route=evil, status=evil, iterations=0),
        certificate=lbt.design.Certificate(
            checks=(check,), gamma=np.nan, rms_per_output=np.zeros(0)
        ),
    )
    written = lbt.interop.export_c(tmp_path / "k.c", design)
    Compiled(written.files[0])
    code = written.files[0].read_text()
    assert code.isascii()
    assert code.count("*/") == code.count("/*")
    assert "main" not in code.split("*/", 1)[1]


@pytest.mark.parametrize("precision", LIMITS)
def test_the_same_design_is_the_same_source(tmp_path, exported, designs, precision):
    again = lbt.interop.export_c(tmp_path / "ctl.c", designs["hinf"], precision=precision)
    texts = [
        [file.read_bytes() for file in files]
        for files in (exported("hinf", precision).files, again.files)
    ]
    assert texts[0] == texts[1]


def test_a_name_of_its_own(tmp_path, designs):
    written = lbt.interop.export_c(
        tmp_path / "tip-tilt.v2.c", designs["integrator"], name="Tip_tilt2"
    )
    assert '#include "tip-tilt.v2.h"' in written.files[0].read_text()
    assert Compiled(written.files[0], name="Tip_tilt2").step([1.0, 0.0])[1] == 0


@pytest.mark.parametrize(
    "name", ["", "2fast", "kal-man", "a b", "_x", "x_", "a__b", "ä", "x;y", "x" * 26, 3, "a\n"]
)
def test_names_that_are_no_identifiers(tmp_path, designs, name):
    with pytest.raises(lbt.errors.ProblemError, match="prefix of the C names must"):
        lbt.interop.export_c(tmp_path / "k.c", designs["integrator"], name=name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", ["k.h", "k", "k.C", 'k".c', "k\\.c", "k\n.c", ".."])
def test_files_that_are_no_source(tmp_path, designs, file):
    with pytest.raises(lbt.errors.OutputError, match=r"must end in \.c"):
        lbt.interop.export_c(tmp_path / file, designs["integrator"], name="k")


def test_single_precision_has_a_largest_number(tmp_path):
    huge = lbt.Controller(A=[[0.5]], B=[[1e39]], C=[[1e-39]], D=[[0.0]])
    lbt.interop.export_c(tmp_path / "k.c", bare_design(huge))
    with pytest.raises(
        lbt.errors.ProblemError, match=r"below 3.4e\+38 in single precision; got 1e\+39 in B"
    ):
        lbt.interop.export_c(tmp_path / "single.c", bare_design(huge), precision="single")
    assert not list(tmp_path.glob("single*"))


def test_arithmetic_that_overflows_is_refused(tmp_path):
    """Coefficients that fit, products that do not."""
    steep = lbt.Controller(A=[[0.5]], B=[[1e30]], C=[[1e30]], D=[[0.0]])
    lbt.interop.export_c(tmp_path / "k.c", bare_design(steep))
    with pytest.raises(lbt.errors.NumericalError, match="must stay finite in single precision"):
        lbt.interop.export_c(tmp_path / "single.c", bare_design(steep), precision="single")
    assert not list(tmp_path.glob("single*"))


def test_a_loop_that_rounding_would_break_is_refused(tmp_path, loaded):
    brink = lbt.integrator(loaded.hardware, gain=1 - 1e-8)  # stable below 1; rounds to 1
    lbt.interop.export_c(tmp_path / "k.c", brink)
    with pytest.raises(lbt.errors.NumericalError, match="as they would be written is unstable"):
        lbt.interop.export_c(tmp_path / "single.c", brink, precision="single")
    assert not list(tmp_path.glob("single*"))


def test_precision_is_one_of_two(tmp_path, designs):
    with pytest.raises(lbt.errors.ProblemError, match="precision must be one of double, single"):
        lbt.interop.export_c(tmp_path / "k.c", designs["integrator"], precision="half")


@pytest.mark.usefixtures("short_rehearsal")
def test_source_and_header_are_both_written_or_none(tmp_path, designs, monkeypatch):
    before = {
        file: file.read_bytes()
        for file in lbt.interop.export_c(tmp_path / "k.c", designs["kalman"]).files
    }
    real, calls = os.fsync, []

    def full(number):
        calls.append(number)
        if len(calls) % 2 == 0:  # the disk takes the first of the files only
            raise OSError(28, "No space left on device")
        real(number)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        for name in ("k.c", "new.c"):
            with pytest.raises(lbt.errors.OutputError, match=r"cannot write .*: No space left"):
                lbt.interop.export_c(tmp_path / name, designs["hinf"])
    assert len(calls) == 4
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before
    (tmp_path / "taken.h").mkdir()
    with pytest.raises(lbt.errors.OutputError, match=r"taken\.h is a directory"):
        lbt.interop.export_c(tmp_path / "taken.c", designs["hinf"])
    assert not (tmp_path / "taken.c").exists()
