"""Controllers by convex synthesis, each with a certificate.

Each method takes a plant or an estimation problem and returns a design.
The certificate is computed after the synthesis and does not trust the solver.
A design that fails its certificate is never returned: the method raises.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# A function that shares its module's name hides the module, whichever is imported first.
from lbt_synth.design.hinf import hinf as hinf  # noqa: E402
from lbt_synth.design.integrator import integrator as integrator  # noqa: E402
from lbt_synth.design.kalman import kalman as kalman  # noqa: E402
from lbt_synth.design.lqg import lqg as lqg  # noqa: E402
from lbt_synth.design.mixed import mixed as mixed  # noqa: E402
from lbt_synth.design.polytopic import polytopic as polytopic  # noqa: E402
from lbt_synth.design.robust import robust as robust  # noqa: E402
