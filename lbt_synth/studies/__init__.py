"""Studies of designs on loops that differ from their model.

Each study answers one question: frequency errors, sensor gains, limits, trade-offs, mirrors.
A Monte Carlo study draws its samples from a configuration, and resumes after an interrupt.
The tables of Agapito et al. (2008) are compared with the published ones.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# A function that shares its module's name hides the module, whichever is imported first.
from lbt_synth.studies.limits import limits as limits  # noqa: E402
from lbt_synth.studies.mirror import mirror as mirror  # noqa: E402
from lbt_synth.studies.robustness import robustness as robustness  # noqa: E402
from lbt_synth.studies.tradeoff import tradeoff as tradeoff  # noqa: E402
from lbt_synth.studies.unexpected_power import unexpected_power as unexpected_power  # noqa: E402
