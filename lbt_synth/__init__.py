"""Certified convex synthesis of tip/tilt controllers for adaptive optics.

A design script takes these names; ``help(lbt_synth.kalman)`` explains one:

- plants: LoopHardware, Atmosphere, Vibration, Truth, tip_tilt_plant, EstimationProblem, load_config
- designs: kalman, hinf, mixed, lqg, robust, integrator, and h2_controller, hinf_controller and
  mixed_controller for any plant; Design, Controller, solve_dare, hinf_norm
- loops: close_loop, loop_margins, residual_budget, simulate, strehl, Imaging
- records: load_record, identify, design_from_record
- files: save_gain, load_gain

The rooms hold the rest: config, design, errors, files, identification, interop, linear, loop,
models, report, studies. ``lbt-synth`` does all of it at the terminal, and
``python -m lbt_synth --help`` lists its commands. Names are imported when first used, so that
``import lbt_synth`` costs nothing.

    >>> import lbt_synth as lbt
    >>> loop = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lbt.integrator(loop, gain=0.5).certificate.passed
    True
"""

import lazy_loader

__version__ = "0.3.0"
__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)  # help() is a page
