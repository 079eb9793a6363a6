"""The league: rivals trained on the past of records and scored on what followed."""
