"""Telemetry of a loop: its series and facts, their files, and those of the AOT standard."""
