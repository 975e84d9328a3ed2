"""Car-to-car rear braking (Euro NCAP CCRb) with a car behind.

cars = Cars()                                     # roles, geometry, Euro NCAP parameters: cars.py
plan = braking_plan(cars, n_skills=5, t_nom_s=0.8)      # speed set-points
schedule = policy("naive").schedule(plans)        # when each skill runs
found = drive(simulator("longitudinal"), cars, plan, schedule)  # drive.py
found.outcomes.name(0), found.outcomes.min_front_gap_m
"""
