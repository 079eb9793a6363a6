"""From what a loop recorded to a model of turbulence, vibrations, noise and sensor."""

from lbt_synth.identification.identify import identify_axis as identify_axis
from lbt_synth.identification.identify import identify_spectrum as identify_spectrum
from lbt_synth.identification.joint import identify as identify
from lbt_synth.identification.result import IdentifiedAxis as IdentifiedAxis
from lbt_synth.identification.result import IdentifiedLine as IdentifiedLine
from lbt_synth.identification.result import IdentifiedModel as IdentifiedModel
from lbt_synth.identification.result import IdentifiedTurbulence as IdentifiedTurbulence
from lbt_synth.identification.whiteness import Whiteness as Whiteness
