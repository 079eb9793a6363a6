"""Export of a controller as the predictive filter of cacao."""
