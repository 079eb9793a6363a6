"""The command line: parse, call the library, print, and turn errors into exit codes."""
