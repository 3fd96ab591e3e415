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

function createDebugAdapterDescriptor(session) {
  const folder = session.workspaceFolder && session.workspaceFolder.uri.fsPath;
  const command = vscode.workspace.getConfiguration("fieldtwin", session.workspaceFolder).get("command");
  const found = find(command, folder);
  if (!found) {
    throw new Error(
      `The command ${command} was not found. Install fieldtwin, or set fieldtwin.command to its path, such as .venv/bin/fieldtwin.`
    );
  }
  return new vscode.DebugAdapterExecutable(found, ["plc", "debug"], { cwd: folder });
}

/** Without a launch.json, debug the unit tests of the open file. */
function resolveDebugConfiguration(folder, given) {
  const empty = !given.type && !given.request && !given.name;
  return empty ? { name: "Unit tests of this file", type: "fieldtwin", request: "launch", program: "${file}" } : given;
}

exports.activate = (context) => {
  context.subscriptions.push(
    vscode.debug.registerDebugAdapterDescriptorFactory("fieldtwin", { createDebugAdapterDescriptor }),
    vscode.debug.registerDebugConfigurationProvider("fieldtwin", { resolveDebugConfiguration })
  );
};
