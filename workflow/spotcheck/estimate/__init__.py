"""From frames to numbers: spot fit, p1 and p2, sensor noise, Fisher information and bounds."""
