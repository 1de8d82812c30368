"""From a configuration to finished runs: commands, plans, sweeps, kills, damage, foreign files."""
