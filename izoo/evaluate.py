"""``python -m izoo.evaluate``: compare a policy with human driving, episode by episode."""

import sys

from izoo.cli.option_command import GOES_ON, OptionCommand

COMMAND = OptionCommand(
    name="evaluate",
    summary="Compare a policy with human driving on the same episodes, and say what it saves.",
    examples=(
        "izoo.evaluate run=runs/RUN",
        "izoo.evaluate run=runs/RUN task=salt_lake_city_to_atlanta simulator=twin",
        "izoo.evaluate policy=glide task=measured contexts.path=DATASET num_workers=8",
        "izoo.evaluate policy=mine.pt contexts=city contexts.city=atlanta num_contexts=32",
        "izoo.evaluate policy=my_package.drivers:calm out=results/calm",
    ),
    config="izoo.conf.evaluate_options:EvaluateConfig",
    work="izoo.cli.evaluate:evaluate",
    defaults="izoo.cli.defaults:of_evaluation",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
