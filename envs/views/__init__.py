"""Other interfaces to the environments: Gymnasium, PettingZoo, tables of trajectories."""
