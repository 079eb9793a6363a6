"""Linear systems whose matrices repeat after a period: sensors that are read at several rates."""
