"""Control of 672 modes of the LBT: ``python benchmarks/modal.py [-o modal.png]``.

Turbulence: 0.8 arcsec, 22 m, 20 m/s, von Karman variances and AR1 poles by radial order. Noise:
assumed, not measured, that of pyramid_modal_noise_nm from 15.5 nm for tip and tilt and a
modulation of 4 lambda/D. Delay 2 frames, 800 Hz.
"""

import argparse

import numpy as np
from harness import seconds

import lbt_synth as lbt
from lbt_synth.models.turbulence.ar_models import radial_orders
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures.studies import modal_figure

MODES, RATE_HZ = 672, 800.0


def total(rms):
    return float(np.sqrt(np.sum(np.asarray(rms) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output")
    output = parser.parse_args().output
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    modes = lbt.models.modal_turbulence(air, modes=MODES, frame_rate_hz=RATE_HZ)
    radial = radial_orders(MODES)
    noise = lbt.models.pyramid_modal_noise_nm(15.5, modes=MODES, modulation_lambda_over_d=4)
    path = lbt.LoopHardware(frame_rate_hz=RATE_HZ)
    known = {"hardware": path, "noise_nm": noise}
    optimised = lbt.design.modal.modal_gains(modes, **known)
    filters = lbt.design.modal.modal_filters(modes, **known)
    rows = {"integrators, optimised gains": optimised.rms_nm, "Kalman filters": filters.rms_nm}
    print(
        f"{'residual [nm rms], AR1 turbulence':36s} {'all':>7s} {'n = 1':>7s} "
        f"{'2 to 9':>7s} {'10 to 36':>8s}"
    )
    parts = [radial > 0, radial == 1, (radial > 1) & (radial < 10), radial > 9]
    for name, rms in {"no correction": modes.rms_nm, **rows}.items():
        figures = [total(rms[part]) for part in parts]
        print(f"{name:36s} {figures[0]:7.1f} {figures[1]:7.1f} {figures[2]:7.1f} {figures[3]:8.1f}")
    some = {n: optimised.gains[radial == n][0] for n in (1, 2, 5, 10, 20, 36)}
    print("optimised gains: " + ", ".join(f"n = {n}: {gain:.3f}" for n, gain in some.items()))

    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    shaken = {0: [line], 1: [line]}
    print("with a vibration of 563.6 nm at 20 Hz on tip and on tilt:")
    gains = lbt.design.modal.modal_gains(modes, **known, vibrations=shaken)
    every = lbt.design.modal.modal_filters(modes, **known, vibrations=shaken)
    rows_shaken = {
        "integrators, optimised gains": gains.rms_nm,
        "Kalman filters": every.rms_nm,
    }
    for name, rms in rows_shaken.items():
        print(f"{name:36s} {total(rms):7.1f} {total(rms[:2]):7.1f}")

    design = seconds(lambda: lbt.design.modal.modal_filters(modes, **known), 9)
    search = seconds(lambda: lbt.design.modal.modal_gains(modes, **known), 9)
    times = f"filters {1e3 * design:.0f} ms, optimised gains {1e3 * search:.0f} ms"
    print(f"design of {MODES} modes: {times}")
    if output:
        figure = modal_figure(rows, gains=optimised.gains, turbulence_nm=modes.rms_nm)
        print(f"written: {save_figure(figure, output)}")


if __name__ == "__main__":
    main()
