"""How noise is removed: levels, mask schedules, and one sampling loop."""
