"""The search of gains: what moves, how trial runs are judged, and the proof of the result."""
