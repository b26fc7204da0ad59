"""C++ kernels. Each module here has one Python wrapper that documents it; nothing else imports it."""
