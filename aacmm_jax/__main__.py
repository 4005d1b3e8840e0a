"""``python -m aacmm_jax`` is ``aacmm``."""

from .cli import main

if __name__ == "__main__":
    main()
