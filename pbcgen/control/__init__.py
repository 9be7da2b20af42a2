"""Laws: in continuous time, discretised, and as the data that C is written from."""
