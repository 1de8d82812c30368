"""The environments: the contract of all, golden trajectories, each task against numbers by hand."""
