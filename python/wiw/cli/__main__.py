# SPDX-License-Identifier: Apache-2.0
"""`python -m wiw.cli` is `wiw`."""

import sys

from wiw.cli import main

if __name__ == "__main__":
    sys.exit(main())
