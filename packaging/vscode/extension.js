// Starts `fieldtwin plc debug`, the debug adapter for Structured Text, for each debugging session of VS Code.
"use strict";

const fs = require("fs");
const path = require("path");
const vscode = require("vscode");

/** Return the path of an executable file: a name is searched for on PATH, a path is relative to the folder. */
function find(command, folder) {
  const named = !/[\\/]/.test(command);
  const folders = named ? (process.env.PATH || "").split(path.delimiter) : [folder || ""];
  const endings = process.platform === "win32" ? ["", ".exe"] : [""];
  return folders
    .flatMap((one) => endings.map((ending) => path.resolve(one, command + ending)))
    .find((file) => {
      try {
        fs.accessSync(file, fs.constants.X_OK);
        return fs.statSync(file).isFile();
      } catch {
        return false;
      }
    });
}

/** Return the path of the command that the settings of a folder name, or nothing, and the name in the settings. */
function adapter(folder) {
  const command = vscode.workspace.getConfiguration("fieldtwin", folder).get("command");
  return { command, found: find(command, folder && folder.uri.fsPath) };
}

function createDebugAdapterDescriptor(session) {
  const folder = session.workspaceFolder;
  return new vscode.DebugAdapterExecutable(adapter(folder).found, ["plc", "debug"], { cwd: folder && folder.uri.fsPath });
}

/** Begin no session without the command, and offer the settings, which name it. */
async function resolveDebugConfigurationWithSubstitutedVariables(folder, given) {
  const { command, found } = adapter(folder);
  if (found || given.debugServer) {
    return given;
  }
  const text = `The command ${command} was not found. Install fieldtwin, or set fieldtwin.command to its path, such as .venv/bin/fieldtwin.`;
  const settings = "Open Settings";
  if ((await vscode.window.showErrorMessage(text, { modal: true }, settings)) === settings) {
    await vscode.commands.executeCommand("workbench.action.openSettings", "fieldtwin.command");
  }
  return undefined;
}

/** Without a launch.json, debug the unit tests of the open file. */
function resolveDebugConfiguration(folder, given) {
  const empty = !given.type && !given.request && !given.name;
  return empty ? { name: "Unit tests of this file", type: "fieldtwin", request: "launch", program: "${file}" } : given;
}

exports.activate = (context) => {
  context.subscriptions.push(
    vscode.debug.registerDebugAdapterDescriptorFactory("fieldtwin", { createDebugAdapterDescriptor }),
    vscode.debug.registerDebugConfigurationProvider("fieldtwin", {
      resolveDebugConfiguration,
      resolveDebugConfigurationWithSubstitutedVariables,
    })
  );
};
