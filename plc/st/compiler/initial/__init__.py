"""Initial values of variables, and the creation of instances with arguments for FB_init."""
