"""The tables of Agapito et al. (2008), computed beside the published ones."""
