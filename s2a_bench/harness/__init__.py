"""What is measured: sessions, interleaving, servers as processes, environment, guards."""
