"""Long campaigns: thousands of seeded cases whose answers are known, with their tables beside them."""
