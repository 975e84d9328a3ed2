"""The measuring harness: sessions, interleaving, servers as processes, environment, guards."""
