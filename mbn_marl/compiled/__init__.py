"""What all compiled rules share: the compiler's settings, random numbers, exact functions."""
