"""`compensator completion`: a script by which a shell completes commands, options and files."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.commands.catalog import COMMANDS, Command

_WHERE = """# compensator: completion of commands, options and files. To use it in every new shell:
#   compensator completion bash > ~/.local/share/bash-completion/completions/compensator
"""
_BASH = """_compensator() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" command="${{COMP_WORDS[1]}}" options=""
  COMPREPLY=()
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{commands} --help --version" -- "$word"))
    return
  fi
  case "$command" in
{cases}
  esac
  if [ "${{word#-}}" != "$word" ]; then COMPREPLY=($(compgen -W "$options" -- "$word")); fi
}}
complete -o default -o bashdefault -F _compensator compensator
"""
_ZSH = "#compdef compensator\n# zsh reads the script for bash.\nautoload -U +X bashcompinit && bashcompinit\n"
_FISH = "# ~/.config/fish/completions/compensator.fish\n"


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    options = {command.name: _options_of(command) for command in COMMANDS}
    if arguments.shell == "fish":
        lines = [
            f'complete -c compensator -n __fish_use_subcommand -f -a {command.name} -d "{command.text}"'
            for command in COMMANDS
        ]
        lines += [
            f'complete -c compensator -n "__fish_seen_subcommand_from {name}" -l {option.removeprefix("--")}'
            for name, found in options.items()
            for option in found
            if option.startswith("--")
        ]
        text = _FISH + "\n".join(lines)
    else:
        cases = "\n".join(f'    {name}) options="{" ".join(found)}" ;;' for name, found in options.items())
        text = (_ZSH if arguments.shell == "zsh" else _WHERE) + _BASH.format(commands=" ".join(options), cases=cases)
    return Answer({"shell": arguments.shell, "script": text}, text.rstrip("\n"))


def _options_of(command: Command) -> list[str]:
    """Return the options of a command, each by its longest name."""
    parser = argparse.ArgumentParser(command.name)
    command.describe(parser)
    found = [max(action.option_strings, key=len) for action in parser._actions if action.option_strings]
    return [*found, "--json", "--debug"]
