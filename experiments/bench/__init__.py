"""How fast we are: a file per part of `make bench`, which is `python -m experiments.bench`."""
