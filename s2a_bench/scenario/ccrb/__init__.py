"""Car-to-car rear braking (Euro NCAP CCRb) with a car behind: options, laws, studies and labels."""
