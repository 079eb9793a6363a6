"""What an observatory recorded: files of any origin, their health, the pseudo-open loop."""
