"""The arguments of each command, declared apart from what runs it so that help stays quick."""
