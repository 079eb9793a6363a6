"""Controllers from measurements for any generalised plant, each with a certificate."""
