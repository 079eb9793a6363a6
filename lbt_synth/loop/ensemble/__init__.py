"""Many loops at once, exactly."""
