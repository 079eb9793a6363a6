"""Studies of designs on loops that differ from their model.

Each study answers one question: frequency errors, sensor gains, limits, trade-offs, mirrors.
A Monte Carlo study draws its samples from a configuration, and resumes after an interrupt.
The tables of Agapito et al. (2008) are compared with the published ones.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
