/* A variable of glibc 2.32 and later that libstdc++ reads. 0: there may be several threads. */
char __libc_single_threaded = 0;
