"""The simulator SUMO, through libsumo: sessions, worker processes, and environments on them."""
