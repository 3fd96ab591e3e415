"""Commands of digital shadows and twins, and of what-if questions."""
