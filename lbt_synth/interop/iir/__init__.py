"""A controller as a transfer-function file of SPECULA."""
