"""The tables of Agapito et al. (2008), compared with the published ones."""
