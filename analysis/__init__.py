"""From finished runs to numbers: tidy frames and statistics; no torch, no MuJoCo."""
