"""Car-to-car rear braking with a car behind: who hits whom under which policy."""
