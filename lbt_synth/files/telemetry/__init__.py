"""Telemetry of a loop: a record, its files, and those of the AOT standard."""
