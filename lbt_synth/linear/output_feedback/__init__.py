"""H2 and H-infinity control from measurements, for any discrete-time generalised plant."""
