"""Export of a controller as transfer functions for SPECULA's IirFilter."""
