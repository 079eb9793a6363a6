"""The tables and figures of Agapito et al. 2008, computed anew beside the published ones."""
