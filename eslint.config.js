import js from "@eslint/js";
import globals from "globals";

const STATIC = ["runner/*/static/*.js"];

export default [
  { ignores: [".venv/", "build/"] },
  js.configs.recommended,
  {
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      eqeqeq: "error",
      "no-shadow": "error",
      "no-unused-vars": ["error", { ignoreRestSiblings: true }], // { timer, ...kept } leaves one out
      "no-var": "error",
      "prefer-const": "error",
    },
  },
  { files: STATIC, languageOptions: { ecmaVersion: 2023, globals: { ...globals.browser, ...globals.worker, Plotly: "readonly" } } },
  { files: ["runner/page/static/*_worklet.js"], languageOptions: { globals: globals.audioWorklet } },
  { files: ["runner/page/static/again.js", "runner/page/static/boot.js", "runner/drive/static/*.js"], languageOptions: { sourceType: "script" } },
  { files: ["tests/js/*.js"], languageOptions: { ecmaVersion: 2023, globals: globals.node } },
];
