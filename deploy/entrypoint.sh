# Begins each container of the image: numba looks for compiled kernels only where it may write, too.
set -e
[ -e "$NUMBA_CACHE_DIR" ] || cp -R "$KERNELS" "$NUMBA_CACHE_DIR"
exec "$@"
