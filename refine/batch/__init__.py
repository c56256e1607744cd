"""Many photos, a material of each: planned, spread over processes or machines, resumed, shown."""
