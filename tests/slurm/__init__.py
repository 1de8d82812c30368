"""Tests of the Slurm launcher on a real one-node Slurm."""
